"""A hash of the code that a class runs, so that results of changed code are not taken for those of the old."""

import hashlib
import inspect
import sys
import sysconfig
from pathlib import Path
from types import ModuleType

_STANDARD = tuple(
    str(Path(sysconfig.get_path(name)).resolve()) for name in ("stdlib", "platstdlib", "purelib", "platlib")
)


def source_hash(kind: type, content: bytes = b"") -> str:
    """(8 hex digits) of the source of a class and of what it imports from its own package or folder.

    Args:
        kind: The class.
        content: What else tells two policies apart, such as a pickled instance.
    """
    digest = hashlib.sha256(content)
    digest.update(f"{kind.__module__}:{kind.__qualname__}".encode())
    files: set[str] = set()
    for base in kind.__mro__[:-1]:
        found = _files(sys.modules.get(base.__module__))
        files |= found
        if not found:
            digest.update(_typed_source(base).encode())
    for path in sorted(files):
        digest.update(Path(path).read_bytes())
    return digest.hexdigest()[:8]


def _files(start: ModuleType | None) -> set[str]:
    """Source files of a module and of those it imports that belong to its own package, or to no package at all."""
    if start is None:
        return set()
    package = start.__name__.partition(".")[0]
    found: dict[str, str] = {}
    waiting = [start]
    while waiting:
        module = waiting.pop()
        path = _source_file(module)
        if path is None or module.__name__ in found:
            continue
        found[module.__name__] = path
        waiting += [other for other in _imported(module) if _belongs(other, package)]
    return set(found.values())


def _imported(module: ModuleType) -> list[ModuleType]:
    """Modules that a module's global names come from."""
    names = {
        value.__name__ if isinstance(value, ModuleType) else getattr(value, "__module__", None)
        for value in vars(module).values()
    }
    return [sys.modules[name] for name in names if isinstance(name, str) and name in sys.modules]


def _belongs(module: ModuleType, package: str) -> bool:
    path = _source_file(module)
    if module.__name__.partition(".")[0] == package:
        return True
    # Scripts and notebooks import from the folders they lie in, not from a package.
    return package == "__main__" and path is not None and not path.startswith(_STANDARD)


def _source_file(module: ModuleType) -> str | None:
    path = getattr(module, "__file__", None)
    if not isinstance(path, str) or not path.endswith(".py"):
        return None
    file = Path(path).resolve()
    return str(file) if file.is_file() else None


def _typed_source(kind: type) -> str:
    """The methods of a class typed into a notebook or at a prompt, as source or else as bytecode."""
    texts = []
    for name, value in sorted(vars(kind).items()):
        function = inspect.unwrap(getattr(value, "fget", None) or getattr(value, "__func__", value))
        code = getattr(function, "__code__", None)
        if code is None:
            texts.append(f"{name}={value!r}" if isinstance(value, (int, float, str, tuple)) else name)
            continue
        try:
            texts.append(inspect.getsource(function))
        except (OSError, TypeError):
            constants = [constant for constant in code.co_consts if not inspect.iscode(constant)]
            texts.append(f"{name} {code.co_code!r} {constants!r} {code.co_names!r}")
    return "\n".join(texts)
