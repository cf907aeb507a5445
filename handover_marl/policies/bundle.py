"""Bundles of a policy with its files, for workers on machines without shared folders."""

import importlib
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from platform import node

from handover_marl.errors import DataNotFoundError, PolicyError
from handover_marl.policies.hashing.source_hash import hash_library, hash_package, hash_packages
from handover_marl.policies.reference import PolicyReference, read_policy_file

# Key of the reference's own policy file among the options that name files.
_FILE = ""


@dataclass(frozen=True)
class PolicyBundle:
    """Policy reference with the contents of the files that the policy reads.

    Attributes:
        reference: Reference to the policy on the machine that packed it.
        code: Hash of the policy's code, which must be installed on the other machine, too; empty
            if the class itself is pickled in the reference.
        files: For each file: the option that names it (empty for the policy file), its path below
            the bundle's folder, and its content. For an option that names a folder, all its files.
    """

    reference: PolicyReference
    code: str
    files: tuple[tuple[str, str, bytes], ...]

    @classmethod
    def pack(cls, reference: PolicyReference) -> "PolicyBundle":
        """Pack a policy reference with the contents of the files that its options name.

        Raises:
            DataNotFoundError: A file cannot be read.
            DataFormatError: A file is a pipe or device, or too large.
        """
        policy_class = reference.policy_class
        options = dict(reference.options)
        paths = {
            option: options[option] for option in policy_class.file_options if isinstance(options.get(option), str)
        }
        if reference.file is not None:
            paths[_FILE] = reference.file
        files = tuple(file for option, path in paths.items() for file in _read_files(option, Path(path).expanduser()))
        return cls(reference, _hash_code(reference) if _is_importable(policy_class) else "", files)

    def unpack(self, folder: Path) -> PolicyReference:
        """Write the bundle's files to a folder; return a reference to the policy with these files.

        Args:
            folder: Existing folder for the bundle's files.

        Raises:
            PolicyError: The policy's code is not installed here, or differs.
        """
        try:
            policy_class = self.reference.policy_class
            code = _hash_code(self.reference) if _is_importable(policy_class) else ""
        except Exception as error:  # importing a user's module may raise anything
            raise self._error(f"is not installed ({type(error).__name__}: {error})") from error
        if self.code and code != self.code:
            raise self._error("is installed with other code")
        options, policy_file = dict(self.reference.options), self.reference.file
        for option, name, content in self.files:
            path = folder / self.reference.agent / (option or "file") / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
            # The files of a folder are named "folder/file"; the option names the folder.
            given = str(path if "/" not in name else path.parent)
            if option == _FILE:
                policy_file = given
            else:
                options[option] = given
        return replace(self.reference, file=policy_file, options=tuple(sorted(options.items())))

    def _error(self, problem: str) -> PolicyError:
        return PolicyError(
            f"on node {node()}: {self.reference.agent} {self.reference.name!r} {problem}; install "
            "the same version there, or pass a class of a script or a notebook, which is sent along"
        )


def _read_files(option: str, path: Path) -> list[tuple[str, str, bytes]]:
    if not path.is_dir():
        return [(option, path.name, read_policy_file(path))]
    try:
        inside = sorted(entry for entry in path.iterdir() if entry.is_file())
    except OSError as error:
        raise DataNotFoundError(f"{path} cannot be read ({error.strerror or error})") from error
    return [(option, f"{path.name}/{entry.name}", read_policy_file(entry)) for entry in inside]


def _hash_code(reference: PolicyReference) -> str:
    parts = [hash_library(), hash_packages(reference.policy_class)]
    for package in reference.packages:
        importlib.import_module(package)
        parts.append(hash_package(package))
    return "".join(parts)


def _is_importable(policy_class: type) -> bool:
    """Return whether pickle stores a class by its name, so that its code is not sent."""
    if policy_class.__module__ == "__main__":
        return False
    found: object = sys.modules.get(policy_class.__module__) or importlib.import_module(policy_class.__module__)
    for name in policy_class.__qualname__.split("."):
        found = getattr(found, name, None)
    return found is policy_class
