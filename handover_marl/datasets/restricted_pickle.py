"""Restricted interpreter of pickles from untrusted files.

A pickle is a program for a stack machine that can run any code. This interpreter knows only the
operations that create data. It returns plain values, inert records and results of functions that the
caller allows; it imports nothing. `pickle.Unpickler` with a restricted `find_class` is not enough:
a file of 300 bytes can make it hash nested tuples without end
(docs/decisions/001-restricted-unpickling.md).
"""

import pickle
import pickletools
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NoReturn

from handover_marl.errors import UnsafeFileError

#: Largest number of operations, which bounds nesting, stack and memory. Official files have 120 to 460.
MAX_OPERATIONS = 10_000
_MAX_INTEGER = 1 << 64
_MAX_MESSAGE_TEXT = 80  # characters


@dataclass(frozen=True)
class AllowedFunction:
    """Function that a pickle may call.

    Attributes:
        call: Implementation, called with the pickle's arguments.
    """

    call: Callable[..., object]


@dataclass(frozen=True)
class AllowedClass:
    """Class of which a pickle may create objects, loaded as `PickledRecord`.

    Attributes:
        kind: Name of the class for the caller.
    """

    kind: str


class PickledObject(ABC):
    """Base class of the objects whose state a pickle may set."""

    __slots__ = ()

    @abstractmethod
    def set_state(self, state: object) -> None:
        """Set the state of the object, as given by the pickle."""


class PickledRecord(PickledObject):
    """Inert replacement of an object whose class is not imported.

    Attributes:
        kind: Name of the class, as the caller has defined it in `AllowedClass`.
        state: Unchecked state of the object.
    """

    __slots__ = ("kind", "state")

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self.state: dict[object, object] = {}

    def set_state(self, state: object) -> None:
        """Set the state, which must be a dict."""
        if not isinstance(state, dict):
            reject(f"the state of {self.kind} is no dict")
        self.state = state


#: What a pickle may use, by module and name.
AllowedNames = Mapping[tuple[str, str], AllowedFunction | AllowedClass]


def reject(reason: str) -> NoReturn:
    """Raise `pickle.UnpicklingError` with a reason."""
    raise pickle.UnpicklingError(reason)


def sanitize_text(text: str) -> str:
    """Return untrusted text for an error message: printable, at most 80 characters."""
    return (text if text.isprintable() else ascii(text))[:_MAX_MESSAGE_TEXT]


def decode_name(value: object) -> str:
    """Return a name in a pickle as text; Python 2 pickles hold names as bytes.

    Raises:
        pickle.UnpicklingError: The value is not text.
    """
    if isinstance(value, bytes):
        return value.decode("ascii")
    if isinstance(value, str):
        return value
    reject(f"expected text, found {type(value).__name__}")


def load_restricted(data: bytes, allowed: AllowedNames) -> object:
    """Load a pickle from an untrusted source without running code from it.

    Text of Python 2 becomes bytes, sets become lists. The memory needed is a small multiple of the
    length of the pickle.

    Args:
        data: Pickle of any protocol.
        allowed: Functions and classes that the pickle may use.

    Raises:
        UnsafeFileError: The pickle uses another name or a forbidden operation; the message is the
            rest of a sentence that starts with "the pickle".
        Exception: The pickle is damaged; any type may be raised.
    """
    interpreter = _Interpreter(allowed, len(data))
    for count, (operation, argument, _) in enumerate(pickletools.genops(data)):
        if count >= MAX_OPERATIONS:
            reject("the pickle is far more intricate than a dict of arrays")
        action = _ACTIONS.get(operation.name)
        if action is None:
            raise UnsafeFileError(f"uses the operation {operation.name}")
        action(interpreter, argument)
    return interpreter.result()


class _Interpreter:
    """Restricted stack machine for pickles, with a method for each allowed opcode."""

    def __init__(self, allowed: AllowedNames, length: int) -> None:
        self._allowed = allowed
        self._length = length
        self._stack: list[Any] = []
        self._marked: list[list[Any]] = []
        self._memo: dict[int, Any] = {}
        self._n_encoded_bytes = 0

    def result(self) -> object:
        """Return the value of the pickle, which must be the only one on the stack."""
        if len(self._stack) != 1 or self._marked:
            reject("the pickle does not end with one value")
        return self._stack[0]

    def push(self, value: object) -> None:
        self._stack.append(value)

    def push_integer(self, value: int) -> None:
        if abs(value) > _MAX_INTEGER:
            reject("a number is too large to be data")
        self.push(value)

    def pop(self, count: int) -> list[Any]:
        if len(self._stack) < count:
            reject("an operation lacks its operands")
        values = self._stack[-count:]
        del self._stack[-count:]
        return values

    def mark(self, _: object) -> None:
        self._marked.append(self._stack)
        self._stack = []

    def pop_mark(self) -> list[Any]:
        values, self._stack = self._stack, self._marked.pop()
        return values

    def push_dict(self, _: object) -> None:
        pairs = self.pop_mark()
        self.push({})
        self.update(pairs)

    def extend(self, values: list[Any]) -> None:
        target = self._stack[-1]
        if type(target) is not list:
            reject(f"elements are added to {type(target).__name__}")
        target.extend(values)

    def update(self, pairs: list[Any]) -> None:
        target = self._stack[-1]
        if type(target) is not dict or len(pairs) % 2:
            reject(f"entries are set in {type(target).__name__}")
        for key, value in zip(pairs[::2], pairs[1::2], strict=True):
            # Hashing nested tuples can take unlimited time.
            if type(key) not in (bytes, str, int):
                reject(f"a key is {type(key).__name__}")
            target[key] = value

    def memoize(self, index: int | None = None) -> None:
        index = len(self._memo) if index is None else index
        # Pickles of data number the memo from 0.
        if not 0 <= index < MAX_OPERATIONS:
            reject("the pickle is far more intricate than a dict of arrays")
        self._memo[index] = self._stack[-1]

    def recall(self, index: int) -> None:
        self.push(self._memo[index])

    def push_name(self, module: object, name: object) -> None:
        if not isinstance(module, str) or not isinstance(name, str):
            reject("a name is no text")
        try:
            self.push(self._allowed[module, name])
        except KeyError:
            raise UnsafeFileError(f"asks for {sanitize_text(f'{module}.{name}')}") from None

    def call(self, _: object) -> None:
        function, arguments = self.pop(2)
        if not isinstance(function, AllowedFunction) or not isinstance(arguments, tuple):
            reject(f"{type(function).__name__} is called")
        value = function.call(*arguments)
        if isinstance(value, bytes):
            # A text can be encoded many times by few operations.
            self._n_encoded_bytes += len(value)
            if self._n_encoded_bytes > self._length:
                reject("the pickle unfolds to more than it holds")
        self.push(value)

    def create(self, _: object) -> None:
        created_class, arguments = self.pop(2)
        if not isinstance(created_class, AllowedClass) or arguments != ():
            reject("an object is made of what is no class, or with arguments")
        self.push(PickledRecord(created_class.kind))

    def set_state(self, _: object) -> None:
        state = self._stack.pop()
        target = self._stack[-1]
        if not isinstance(target, PickledObject):
            reject(f"{type(target).__name__} has no state")
        target.set_state(state)


_INTEGERS = ("BININT", "BININT1", "BININT2", "INT", "LONG", "LONG1", "LONG4")
_VALUES = (
    *("FLOAT", "BINFLOAT", "UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8"),
    *("BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8"),
)
_PYTHON_2_TEXT = ("STRING", "BINSTRING", "SHORT_BINSTRING")

_ACTIONS: dict[str, Callable[[_Interpreter, Any], None]] = {
    **dict.fromkeys(("PROTO", "FRAME", "STOP"), lambda interpreter, _: None),
    **dict.fromkeys(_INTEGERS, _Interpreter.push_integer),
    **dict.fromkeys(_VALUES, _Interpreter.push),
    **dict.fromkeys(_PYTHON_2_TEXT, lambda interpreter, text: interpreter.push(text.encode("latin1"))),
    "NONE": lambda interpreter, _: interpreter.push(None),
    "NEWTRUE": lambda interpreter, _: interpreter.push(True),
    "NEWFALSE": lambda interpreter, _: interpreter.push(False),
    "EMPTY_DICT": lambda interpreter, _: interpreter.push({}),
    "EMPTY_TUPLE": lambda interpreter, _: interpreter.push(()),
    # Sets become lists, since hashing their elements can take unlimited time.
    **dict.fromkeys(("EMPTY_LIST", "EMPTY_SET"), lambda interpreter, _: interpreter.push([])),
    "TUPLE1": lambda interpreter, _: interpreter.push(tuple(interpreter.pop(1))),
    "TUPLE2": lambda interpreter, _: interpreter.push(tuple(interpreter.pop(2))),
    "TUPLE3": lambda interpreter, _: interpreter.push(tuple(interpreter.pop(3))),
    "TUPLE": lambda interpreter, _: interpreter.push(tuple(interpreter.pop_mark())),
    **dict.fromkeys(("LIST", "FROZENSET"), lambda interpreter, _: interpreter.push(interpreter.pop_mark())),
    "DICT": _Interpreter.push_dict,
    "MARK": _Interpreter.mark,
    "APPEND": lambda interpreter, _: interpreter.extend(interpreter.pop(1)),
    **dict.fromkeys(("APPENDS", "ADDITEMS"), lambda interpreter, _: interpreter.extend(interpreter.pop_mark())),
    "SETITEM": lambda interpreter, _: interpreter.update(interpreter.pop(2)),
    "SETITEMS": lambda interpreter, _: interpreter.update(interpreter.pop_mark()),
    "GLOBAL": lambda interpreter, name: interpreter.push_name(*name.split(" ", 1)),
    "STACK_GLOBAL": lambda interpreter, _: interpreter.push_name(*interpreter.pop(2)),
    "REDUCE": _Interpreter.call,
    "NEWOBJ": _Interpreter.create,
    "BUILD": _Interpreter.set_state,
    **dict.fromkeys(("PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE"), _Interpreter.memoize),
    **dict.fromkeys(("GET", "BINGET", "LONG_BINGET"), _Interpreter.recall),
}
