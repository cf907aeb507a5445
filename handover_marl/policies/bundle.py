"""Bundles of a policy with its files, for workers on machines without shared folders."""

import importlib
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from platform import node

from handover_marl.errors import PolicyError
from handover_marl.policies.hashing import hash_object
from handover_marl.policies.reference import PolicyReference


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
        code = _hash_code(reference) if _is_importable(reference.policy_class) else ""
        return cls(reference, code, tuple(reference.read_files()))

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
            if option:
                options[option] = given
            else:
                policy_file = given
        return replace(self.reference, file=policy_file, options=tuple(sorted(options.items())))

    def _error(self, problem: str) -> PolicyError:
        return PolicyError(
            f"on node {node()}: {self.reference.agent} {self.reference.name!r} {problem}; install "
            "the same version there, or pass a class of a script or a notebook, which is sent along"
        )


def _hash_code(reference: PolicyReference) -> str:
    packages = [importlib.import_module(package) for package in reference.packages]
    return hash_object((reference.policy_class, packages))


def _is_importable(policy_class: type) -> bool:
    """Return whether pickle stores a class by its name, so that its code is not sent."""
    if policy_class.__module__ == "__main__":
        return False
    found: object = sys.modules.get(policy_class.__module__) or importlib.import_module(policy_class.__module__)
    for name in policy_class.__qualname__.split("."):
        found = getattr(found, name, None)
    return found is policy_class
