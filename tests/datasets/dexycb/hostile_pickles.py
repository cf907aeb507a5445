"""Hostile model files, and a program that reads them and checks for side effects.

`python -m tests.datasets.dexycb.hostile_pickles FOLDER` reads all of them. It fails if reading a file imports or
runs something or opens another file, or does not raise one of the library's own errors.
"""

import os
import sys
from pathlib import Path

import numpy as np

from handover_marl.datasets.dexycb.mano import read_mano_model
from handover_marl.errors import DataFormatError
from tests.datasets.dexycb.mano_files import array, integer, mapping, name, record, sequence, text, write

TOUCH = text("touch was_run")


def file(entry: bytes) -> bytes:
    """Return a pickled dict with the only key `weights`, whose value is made by these operations."""
    return b"\x80\x05" + b"}" + text("weights") + entry + b"s."


def called(module: str, attribute: str, *arguments: bytes) -> bytes:
    return name(module, attribute) + sequence(*arguments) + b"R"


def stack_global(module: str, attribute: str) -> bytes:
    def unicode(value: str) -> bytes:
        return b"\x8c" + bytes([len(value)]) + value.encode()

    return unicode(module) + unicode(attribute) + b"\x93"


#: Operations that request names that no model contains; they are refused as unsafe.
UNSAFE = {
    "os.system": called("os", "system", TOUCH),
    "posix.system": called("posix", "system", TOUCH),
    "eval": called("builtins", "eval", text("open('was_run', 'w')")),
    "Python 2's eval": called("__builtin__", "eval", text("open('was_run', 'w')")),
    "eval by its name on the stack": stack_global("builtins", "eval") + sequence(text("1")) + b"R",
    "getattr": called("builtins", "getattr", name("numpy", "ndarray"), text("__subclasses__")),
    "an attribute of a class": stack_global("chumpy.ch", "Ch.__init__"),
    "a class in a class": stack_global("chumpy", "ch.Ch"),
    "an attribute of an admitted function": stack_global("numpy", "dtype.__class__"),
    "a module": stack_global("scipy.sparse", "csc"),
    "numpy's loader": called("numpy", "load", text("was_run")),
    "scipy's own matrix": called("scipy.sparse", "csc_matrix", sequence(integer(16), integer(778))),
    "another class": name("io", "BytesIO") + b")\x81",
    "another class by its name on the stack": stack_global("subprocess", "Popen") + sequence(TOUCH) + b"\x81",
    "a chain of reductions": called("copyreg", "_reconstructor", name("chumpy.ch", "Ch"), name("builtins", "object")),
    "an instance of Python 2": b"(" + TOUCH + b"ios\nsystem\n",
}

DICT_OF_TRICKS = mapping(__class__=name("chumpy.ch", "Ch"), __dict__=b"}", __setstate__=integer(1), state=b"}")
#: Operations with names of models, in combinations that no model has.
DAMAGED = {
    "another class with keywords": name("chumpy.ch", "Ch") + b")}\x92",
    "an instance from the stack": b"(" + name("chumpy.ch", "Ch") + TOUCH + b"o",
    "extension 1": b"\x82\x01",
    "extension 2": b"\x83\x01\x00",
    "extension 4": b"\x84\x01\x00\x00\x00",
    "a persistent id": b"Pwas_run\n",
    "a persistent id from the stack": text("was_run") + b"Q",
    "a buffer of its own": b"\x97",
    "a read-only buffer": b"\x96" + (8).to_bytes(8, "little") + bytes(8) + b"\x98",
    "duplicates": b")0N2",
    "a record with tricks": name("chumpy.ch", "Ch") + b")\x81" + DICT_OF_TRICKS + b"b",
    "a record with slots": name("chumpy.ch", "Ch") + b")\x81N" + DICT_OF_TRICKS + b"\x86b",
    "a record of no state": name("chumpy.ch", "Ch") + b")\x81",
    "a class with a state": name("chumpy.ch", "Ch") + DICT_OF_TRICKS + b"b",
    "a function with a state": name("numpy", "dtype") + DICT_OF_TRICKS + b"b",
    "a dict with a state": b"}" + DICT_OF_TRICKS + b"b",
    "a list with a state": b"]" + DICT_OF_TRICKS + b"b",
    "an array with a state of tricks": array(np.zeros(1)) + DICT_OF_TRICKS + b"b",
    "a class that is called": called("chumpy.ch", "Ch"),
    "a class with arguments": name("chumpy.ch", "Ch") + sequence(TOUCH) + b"\x81",
    "an object of a function": name("__builtin__", "set") + b")\x81",
    "an object of a record": record("chumpy.ch", "Ch") + b")\x81",
    "numpy.ndarray called": called("numpy", "ndarray", sequence(integer(1)), text("O"), text("A" * 8)),
    "a number that is called": integer(1) + b")R",
    "arguments that are none": name("numpy", "dtype") + integer(1) + b"R",
    "another codec": called("_codecs", "encode", b"\x8c\x01a", b"\x8c\x03idn"),
    "a name that is no text": integer(1) + integer(2) + b"\x93",
    "an array of objects": called("numpy", "dtype", text("O8"), integer(0), integer(1)),
    "a key that is a tuple": b"}" + sequence(integer(1)) + b"Ns",
    "entries of a list": b"]" + integer(1) + b"Ns",
    "an odd entry": b"}(" + integer(1) + b"u",
    "elements of a dict": b"}" + integer(1) + b"a",
    "nothing to mark": b"t",
}

_DOUBLED_TUPLES = b")q\x00" + b"".join(bytes([ord("h"), k, 0x86, ord("q"), k + 1]) for k in range(99))
_DOUBLED_LISTS = b"(" * 99 + b"]q\x00" + b"".join(bytes([ord("h"), k, ord("l"), ord("q"), k + 1]) for k in range(99))
_LONG_NUMBER = b"\x8b" + (1_000_000).to_bytes(4, "little") + b"\x7f" * 1_000_000
_F8 = called("numpy", "dtype", text("f8"))
_SIZE = sequence(integer(2**30), integer(2**30), integer(2**30))
#: Operations that would fill the memory or overflow the stack if they were not limited.
EXHAUSTING = {
    "lists in lists": b"]" * 9_000 + b"a" * 8_999,
    "tuples in tuples": b")" + b"\x85" * 9_000,
    "far more tuples in tuples": b")" + b"\x85" * 500_000,
    "dicts in dicts": (b"}" + text("x")) * 4_000 + b"N" + b"s" * 4_000,
    "records in records": (name("chumpy.ch", "Ch") + b")\x81}" + text("x")) * 1_500 + b"N" + b"sb" * 1_500,
    "tuples that double": _DOUBLED_TUPLES,
    "a shape of tuples that double": called("numpy.core.multiarray", "_reconstruct")
    + sequence(integer(1), _DOUBLED_TUPLES, _F8, b"\x89", text(b""))
    + b"b",
    "a type of tuples that double": name("numpy", "dtype") + sequence(_DOUBLED_TUPLES) + b"R",
    "a codec of tuples that double": name("_codecs", "encode") + sequence(b"\x8c\x01a", _DOUBLED_TUPLES) + b"R",
    "lists that double": _DOUBLED_LISTS,
    "a list in itself": b"]q\x00h\x00a",
    "a high memo index": b"Nr\xff\xff\xff\x7f",
    "a high memo index in words": b"Np2147483647\n",
    "a negative memo index": b"Np-1\n",
    "text that is not there": b"T\xff\xff\xff\x7fabc",
    "text of negative length": b"T\xff\xff\xff\xffabc",
    "bytes that are not there": b"\x8e" + (2**62).to_bytes(8, "little"),
    "an array of bytes that are not there": b"\x96" + (2**62).to_bytes(8, "little"),
    "a frame that is not there": b"\x95" + (2**62).to_bytes(8, "little"),
    "a number that is not there": b"\x8b\xff\xff\xff\x7f",
    "a number of a million bytes": _LONG_NUMBER,
    "a shape of such numbers": called("numpy.core.multiarray", "_reconstruct")
    + sequence(integer(1), sequence(_LONG_NUMBER, b"q\x00" + b"h\x00" * 2_000), _F8, b"\x89", text(b""))
    + b"b",
    "a number of a million digits": b"L" + b"9" * 1_000_000 + b"L\n",
    "a shape beyond the data": called("numpy.core.multiarray", "_reconstruct")
    + sequence(integer(1), _SIZE, _F8, b"\x89", text(b""))
    + b"b",
    "elements of no size": called("numpy.core.multiarray", "_reconstruct")
    + sequence(integer(1), _SIZE, called("numpy", "dtype", text("S0")), b"\x89", text(b""))
    + b"b",
    "many operations": b"N" * 1_000_000,
}

HOSTILE = {
    **{what: file(entry) for what, entry in {**UNSAFE, **DAMAGED, **EXHAUSTING}.items()},
    "nothing": b"",
    "no operation": b"\x80\x02",
    "no value": b"\x80\x02.",
    "nothing to add to": b"\x80\x02]a.",
    "nothing to set in": b"\x80\x02NNs.",
    "nothing to remember": b"\x80\x02q\x00.",
    "nothing to remember it by": b"\x80\x02h\x00.",
    "two values": b"\x80\x02}}.",
    "a mark left over": b"\x80\x02(}.",
    "an unknown operation": b"\x80\x02\xff.",
    "a list": b"\x80\x02].",
    "keys that are numbers": b"\x80\x02}K\x01Ns.",
    "keys that are no ASCII": b"\x80\x02}U\x01\xe9Ns.",
    "two keys of one name": b"\x80\x02}(U\x01aN\x8c\x01aNu.",
}

_watched: list[str] = []
_on = False


def _watch(event: str, arguments: tuple[object, ...]) -> None:
    # Opening the model file itself is the only permitted event.
    if _on and (event != "open" or Path(str(arguments[0])).name != "MANO_RIGHT.pkl"):
        _watched.append(f"{event} {arguments!r:.200}")


def main(folder: Path) -> None:
    global _on
    path = folder / "MANO_RIGHT.pkl"
    os.chdir(folder)
    sys.addaudithook(_watch)
    for what, data in HOSTILE.items():
        write(path, data)
        # The first read may import codecs and NumPy's error texts, so only events of the second read are recorded.
        for watching in (False, True):
            _on = watching
            try:
                read_mano_model(path, "right")
            except DataFormatError:
                pass
            else:
                sys.exit(f"{what}: read without an error")
            finally:
                _on = False
            if _watched:
                sys.exit(f"{what}: {_watched}")
    if list(folder.iterdir()) != [path]:
        sys.exit(f"left behind: {list(folder.iterdir())}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
