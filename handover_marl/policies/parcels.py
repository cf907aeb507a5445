"""Policies on their way to a machine that shares no files with this one."""

import importlib
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from platform import node

from handover_marl.errors import DataNotFoundError, PolicyError
from handover_marl.policies.reference import PolicyReference
from handover_marl.policies.source_hash import code_hash

# What stands for the reference's own file among the options that name files.
_FILE = ""


@dataclass(frozen=True)
class Parcel:
    """A policy with what its making needs.

    Attributes:
        reference: The policy, as it is here.
        code: Hash of its code, which must be on the other machine, too; empty if the code goes with it.
        files: Option that names a file, the file's own name, and what is in it; of a folder all files in it.
    """

    reference: PolicyReference
    code: str
    files: tuple[tuple[str, str, bytes], ...]

    @classmethod
    def of(cls, reference: PolicyReference) -> "Parcel":
        """A policy with the files that it names (`Policy.file_options`).

        Raises:
            DataNotFoundError: A file cannot be read.
        """
        kind = reference.kind
        options = dict(reference.options)
        named = {option: options[option] for option in kind.file_options if isinstance(options.get(option), str)}
        if reference.file is not None:
            named[_FILE] = reference.file
        files = tuple(found for option, path in named.items() for found in _read(option, Path(path).expanduser()))
        return cls(reference, code_hash(kind) if _is_elsewhere_by_name(kind) else "", files)

    def unpacked(self, folder: Path) -> PolicyReference:
        """The policy as it is made on this machine.

        Args:
            folder: Where its files go.

        Raises:
            PolicyError: Its code is not here, or is another.
        """
        try:
            kind = self.reference.kind
        except Exception as error:  # a module that is imported may do anything
            raise PolicyError(self._told(f"is not there ({type(error).__name__}: {error})")) from error
        if self.code and code_hash(kind) != self.code:
            raise PolicyError(self._told("is there with other code"))
        options, file = dict(self.reference.options), self.reference.file
        for option, name, content in self.files:
            path = folder / self.reference.agent / (option or "file") / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
            # A folder's files have its name before theirs.
            whole = str(path if "/" not in name else path.parent)
            if option == _FILE:
                file = whole
            else:
                options[option] = whole
        return replace(self.reference, file=file, options=tuple(sorted(options.items())))

    def _told(self, what: str) -> str:
        return (
            f"on node {node()}: {self.reference.agent} {self.reference.text!r} {what}; install the same there, or pass "
            "a class that is written in a script or a notebook, which is sent along"
        )


def _read(option: str, path: Path) -> list[tuple[str, str, bytes]]:
    try:
        if path.is_dir():
            inside = sorted(entry for entry in path.iterdir() if entry.is_file())
            return [(option, f"{path.name}/{entry.name}", entry.read_bytes()) for entry in inside]
        return [(option, path.name, path.read_bytes())]
    except OSError as error:
        raise DataNotFoundError(f"{path} cannot be read ({error.strerror or error})") from error


def _is_elsewhere_by_name(kind: type) -> bool:
    """Whether pickle finds a class by its name, so that its code is not sent."""
    if kind.__module__ == "__main__":
        return False
    found: object = sys.modules.get(kind.__module__) or importlib.import_module(kind.__module__)
    for name in kind.__qualname__.split("."):
        found = getattr(found, name, None)
    return found is kind
