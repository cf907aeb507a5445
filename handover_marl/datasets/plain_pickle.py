"""Reading pickles without unpickling them.

A pickle is a program for a small stack machine, and Python's own machine can be made to run any code, to fill the
memory or to hash for ever. This one knows the operations that data are written with, and no others. It makes plain
values, inert records and what a reader's own functions return; it imports nothing and calls nothing of a stranger.
"""

import pickle
import pickletools
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NoReturn

from handover_marl.errors import UnsafeFileError

#: Official files have 120 to 460 operations. The limit keeps hostile nesting from exhausting stack and memory.
MAX_OPERATIONS = 10_000
_LARGEST_INTEGER = 1 << 64
_LONGEST_SHOWN = 80


@dataclass(frozen=True)
class Function:
    """What a pickle gets for the name of a function that the reader admits; only REDUCE calls it."""

    call: Callable[..., object]


@dataclass(frozen=True)
class RecordClass:
    """What a pickle gets for the name of a class that the reader admits; NEWOBJ makes a `Record` of it."""

    kind: str


class Stateful(ABC):
    """What a BUILD operation may give a state to."""

    __slots__ = ()

    @abstractmethod
    def set_state(self, state: object) -> None:
        """Take over the state."""


class Record(Stateful):
    """Stands in for an object of a class that is not imported.

    Attributes:
        kind: The name that the reader has for the class.
        state: What the object consists of; nothing of it has been looked at.
    """

    __slots__ = ("kind", "state")

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self.state: dict[object, object] = {}

    def set_state(self, state: object) -> None:
        """Take over the state, a dict."""
        if not isinstance(state, dict):
            refuse(f"the state of {self.kind} is no dict")
        self.state = state


#: Module and name, as the pickle has them -> what the pickle gets for them.
Names = Mapping[tuple[str, str], Function | RecordClass]


def refuse(reason: str) -> NoReturn:
    """Raise the error of a pickle that cannot be read."""
    raise pickle.UnpicklingError(reason)


def shown(text: str) -> str:
    """A stranger's text as it may stand in a message: short, on one line, without control characters."""
    return (text if text.isprintable() else ascii(text))[:_LONGEST_SHOWN]


def decoded(value: object) -> str:
    """A name as text; Python 2 wrote names as bytes.

    Raises:
        pickle.UnpicklingError: It is no text.
    """
    if isinstance(value, bytes):
        return value.decode("ascii")
    if isinstance(value, str):
        return value
    refuse(f"expected text, found {type(value).__name__}")


def load_plain(data: bytes, names: Names) -> object:
    """The value of a pickle; Python 2's text becomes bytes, and sets become lists.

    Args:
        data: The pickle, which needs memory of a few times its length.
        names: What it may ask for.

    Raises:
        UnsafeFileError: It asks for something else; the message is the rest of a sentence about the pickle.
        Exception: It is damaged. There is no end to what that can raise.
    """
    machine = _Machine(names, len(data))
    for count, (operation, argument, _) in enumerate(pickletools.genops(data)):
        if count >= MAX_OPERATIONS:
            refuse("the pickle is far more intricate than a dict of arrays")
        machine.run(operation.name, argument)
    return machine.result()


_INTEGERS = frozenset({"BININT", "BININT1", "BININT2", "INT", "LONG", "LONG1", "LONG4"})
_OTHER_VALUES = frozenset(
    {"FLOAT", "BINFLOAT", "UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8"}
    | {"BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8"}
)
_PYTHON_2_TEXT = frozenset({"STRING", "BINSTRING", "SHORT_BINSTRING"})
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_NEW: dict[str, Callable[[], object]] = {
    "EMPTY_DICT": dict,
    "EMPTY_LIST": list,
    "EMPTY_TUPLE": tuple,
    # Sets would hash what they are given, and nothing that is needed is one.
    "EMPTY_SET": list,
}
_TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
_NOTHING_TO_DO = frozenset({"PROTO", "FRAME", "STOP"})


class _Machine:
    """Stack and memo of one pickle while it is read."""

    def __init__(self, names: Names, length: int) -> None:
        self._names = names
        self._length = length
        self._stack: list[Any] = []
        self._below: list[list[Any]] = []
        self._memo: dict[int, Any] = {}
        self._bytes_made = 0

    def run(self, operation: str, argument: Any) -> None:
        """Carry out one operation, named as in `pickletools`."""
        if operation in _INTEGERS:
            if abs(argument) > _LARGEST_INTEGER:
                refuse("a number is too large to be data")
            self.push(argument)
        elif operation in _OTHER_VALUES:
            self.push(argument)
        elif operation in _PYTHON_2_TEXT:
            self.push(argument.encode("latin1"))
        elif operation in _CONSTANTS:
            self.push(_CONSTANTS[operation])
        elif operation in _NEW:
            self.push(_NEW[operation]())
        elif operation in _TUPLES:
            self.push(tuple(self.pop(_TUPLES[operation])))
        elif operation in _ACTIONS:
            _ACTIONS[operation](self, argument)
        elif operation not in _NOTHING_TO_DO:
            raise UnsafeFileError(f"uses the operation {operation}")

    def result(self) -> object:
        """The only value left after the last operation."""
        if len(self._stack) != 1 or self._below:
            refuse("the pickle does not end with one value")
        return self._stack[0]

    def push(self, value: object) -> None:
        self._stack.append(value)

    def pop(self, count: int) -> list[Any]:
        if len(self._stack) < count:
            refuse("an operation lacks its operands")
        values = self._stack[-count:]
        del self._stack[-count:]
        return values

    def mark(self) -> None:
        self._below.append(self._stack)
        self._stack = []

    def to_mark(self) -> list[Any]:
        values, self._stack = self._stack, self._below.pop()
        return values

    def new_dict(self) -> None:
        pairs = self.to_mark()
        self.push({})
        self.update(pairs)

    def extend(self, values: list[Any]) -> None:
        target = self._stack[-1]
        if type(target) is not list:
            refuse(f"elements are added to {type(target).__name__}")
        target.extend(values)

    def update(self, pairs: list[Any]) -> None:
        target = self._stack[-1]
        if type(target) is not dict or len(pairs) % 2:
            refuse(f"entries are set in {type(target).__name__}")
        for key, value in zip(pairs[::2], pairs[1::2], strict=True):
            # Tuples in tuples can take ages to hash.
            if type(key) not in (bytes, str, int):
                refuse(f"a key is {type(key).__name__}")
            target[key] = value

    def put(self, index: int | None = None) -> None:
        index = len(self._memo) if index is None else index
        # Python's own machine makes a memo as long as its highest index, so no pickle of data has a high one.
        if not 0 <= index < MAX_OPERATIONS:
            refuse("the pickle is far more intricate than a dict of arrays")
        self._memo[index] = self._stack[-1]

    def get(self, index: int) -> None:
        self.push(self._memo[index])

    def name(self, module: object, name: object) -> None:
        if not isinstance(module, str) or not isinstance(name, str):
            refuse("a name is no text")
        try:
            self.push(self._names[module, name])
        except KeyError:
            raise UnsafeFileError(f"asks for {shown(f'{module}.{name}')}") from None

    def reduce(self, function: object, arguments: object) -> None:
        if not isinstance(function, Function) or not isinstance(arguments, tuple):
            refuse(f"{type(function).__name__} is called")
        made = function.call(*arguments)
        if isinstance(made, bytes):
            # Each piece is made of text in the pickle, once; a few operations could make it a thousand times.
            self._bytes_made += len(made)
            if self._bytes_made > self._length:
                refuse("the pickle unfolds to more than it holds")
        self.push(made)

    def new(self, made_of: object, arguments: object) -> None:
        if not isinstance(made_of, RecordClass) or arguments != ():
            refuse("an object is made of what is no class, or with arguments")
        self.push(Record(made_of.kind))

    def build(self) -> None:
        state = self._stack.pop()
        target = self._stack[-1]
        if not isinstance(target, Stateful):
            refuse(f"{type(target).__name__} has no state")
        target.set_state(state)


_ACTIONS: dict[str, Callable[[_Machine, Any], None]] = {
    "MARK": lambda machine, _: machine.mark(),
    "TUPLE": lambda machine, _: machine.push(tuple(machine.to_mark())),
    **dict.fromkeys(("LIST", "FROZENSET"), lambda machine, _: machine.push(machine.to_mark())),
    "DICT": lambda machine, _: machine.new_dict(),
    "APPEND": lambda machine, _: machine.extend(machine.pop(1)),
    **dict.fromkeys(("APPENDS", "ADDITEMS"), lambda machine, _: machine.extend(machine.to_mark())),
    "SETITEM": lambda machine, _: machine.update(machine.pop(2)),
    "SETITEMS": lambda machine, _: machine.update(machine.to_mark()),
    "GLOBAL": lambda machine, name: machine.name(*name.split(" ", 1)),
    "STACK_GLOBAL": lambda machine, _: machine.name(*machine.pop(2)),
    "REDUCE": lambda machine, _: machine.reduce(*machine.pop(2)),
    "NEWOBJ": lambda machine, _: machine.new(*machine.pop(2)),
    "BUILD": lambda machine, _: machine.build(),
    **dict.fromkeys(("PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE"), _Machine.put),
    **dict.fromkeys(("GET", "BINGET", "LONG_BINGET"), _Machine.get),
}
