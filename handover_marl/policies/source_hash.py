"""A hash of the code that a class runs, so that results of changed code are not taken for those of the old."""

import functools
import hashlib
import importlib.util
import inspect
import re
import sys
import sysconfig
from pathlib import Path
from types import FunctionType

# Where installed packages lie, those of the user and of another environment that this one borrows from included.
_STANDARD = tuple(
    str(Path(folder).resolve())
    for folder in (
        *(sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")),
        *(folder for folder in sys.path if Path(folder).name in ("site-packages", "dist-packages")),
    )
)

_PLAIN = (int, float, str, bytes, tuple, type(None))
_IMPORT = re.compile(
    r"^[ \t]*(?:from[ \t]+([.\w]+)[ \t]+import[ \t]+(\([^)]*\)|[^\n#;]+)|import[ \t]+([\w., \t]+))", re.MULTILINE
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
        start = _start(base)
        files |= set(_files(base.__module__, start).values()) if start else set()
        if start is None or "<locals>" in base.__qualname__:
            digest.update(_typed_source(base).encode())
    for path in sorted(files):
        digest.update(Path(path).read_bytes())
    return digest.hexdigest()[:8]


def code_hash(kind: type) -> str:
    """(8 hex digits) of the sources that are the class's own, wherever they are installed: its package, its folder."""
    files: dict[str, str] = {}
    for base in kind.__mro__[:-1]:
        start = _start(base)
        for name, path in _files(base.__module__, start).items() if start else ():
            own = name.partition(".")[0] == base.__module__.partition(".")[0]
            if own or Path(path).parent == Path(start or "").parent:
                files[name] = path
    parts = [name.encode() + b"\0" + Path(path).read_bytes() for name, path in sorted(files.items())]
    return hashlib.sha256(b"\0".join(parts)).hexdigest()[:8]


def _start(kind: type) -> str | None:
    """The source file of the module that a class is written in, or None at a prompt and in notebooks."""
    path = getattr(sys.modules.get(kind.__module__), "__file__", None)
    return path if isinstance(path, str) and path.endswith(".py") and Path(path).is_file() else None


def _files(name: str, path: str) -> dict[str, str]:
    """Source files, by name, of a module and of those it imports that belong to its package, or are nobody's package.

    Told from the sources alone: what else happens to be loaded must not count.
    """
    package = name.partition(".")[0]
    found = {name: path}
    waiting = [(name, path)]
    while waiting:
        for other in _imported_names(*waiting.pop()):
            where = None if other in found else _source_file(other, package)
            if where is not None and _belongs(other, where, package):
                found[other] = where
                waiting.append((other, where))
    return found


def _imported_names(name: str, path: str) -> set[str]:
    """Names that may be modules which a module's source imports, wherever in it."""
    package = name if Path(path).name == "__init__.py" else name.rpartition(".")[0]
    names: set[str] = set()
    for base, several, plain in _import_statements(path, Path(path).stat().st_mtime_ns):
        if plain:
            names.update(part.split(" as ")[0].strip() for part in plain.split(","))
            continue
        level = len(base) - len(base.lstrip("."))
        parent = package.split(".")[: len(package.split(".")) - level + 1] if level else []
        whole = ".".join([*parent, base.lstrip(".")]).strip(".")
        names.add(whole)
        names.update(f"{whole}.{part.split(' as ')[0].strip()}" for part in several.strip("()").split(","))
    # "import a.b" loads "a", too.
    return {part for part in names | {name.rpartition(".")[0] for name in names} if part}


@functools.lru_cache(maxsize=1024)
def _import_statements(path: str, changed: int) -> tuple[tuple[str, str, str], ...]:
    return tuple(_IMPORT.findall(Path(path).read_text(errors="replace")))


def _belongs(name: str, path: str, package: str) -> bool:
    if name.partition(".")[0] == package:
        return True
    # Scripts, notebooks and modules beside them import from the folders they lie in, not from installed packages.
    return not path.startswith(_STANDARD)


def _source_file(name: str, package: str) -> str | None:
    """Where a module's source is; nothing is run but packages of one's own that enclose it."""
    top = name.partition(".")[0]
    if top in sys.stdlib_module_names:
        return None
    if top != name:
        whole = _origin(top, tuple(sys.path))
        if whole is None or (whole.startswith(_STANDARD) and top != package):
            return None
    return _origin(name, tuple(sys.path))


@functools.lru_cache(maxsize=4096)
def _origin(name: str, search_path: tuple[str, ...]) -> str | None:
    try:
        spec = importlib.util.find_spec(name)
    except Exception:  # packages that enclose it are run, and may refuse, e.g. on this system; stubs put anything there
        return None
    if spec is None or not spec.origin or not spec.origin.endswith(".py"):
        return None
    return str(Path(spec.origin).resolve())


def _typed_source(kind: type) -> str:
    """The methods of a class that was typed in or made by a function, and the plain values that they use."""
    texts = []
    for name, value in sorted(vars(kind).items()):
        function = inspect.unwrap(getattr(value, "fget", None) or getattr(value, "__func__", value))
        code = getattr(function, "__code__", None)
        if code is None:
            texts.append(f"{name}={value!r}" if isinstance(value, _PLAIN) else name)
            continue
        used = inspect.getclosurevars(function)
        values = sorted({**used.globals, **used.nonlocals}.items())
        texts += [f"{key}={item!r}" for key, item in values if isinstance(item, _PLAIN)]
        helpers = [item for _, item in values if inspect.isfunction(item) and not _is_written(item)]
        texts += [repr((item.__code__.co_code, item.__code__.co_names, _constants(item))) for item in helpers]
        try:
            texts.append(inspect.getsource(function))
        except (OSError, TypeError):
            texts.append(f"{name} {code.co_code!r} {_constants(function)!r} {code.co_names!r}")
    return "\n".join(texts)


def _constants(function: FunctionType) -> list[object]:
    return [constant for constant in function.__code__.co_consts if not inspect.iscode(constant)]


def _is_written(function: FunctionType) -> bool:
    """Whether a function stands in a file, which is hashed as a whole."""
    return Path(function.__code__.co_filename).is_file()
