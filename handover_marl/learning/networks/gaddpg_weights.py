"""Reader of the original authors' GA-DDPG checkpoints that runs no code from them.

Their code (github.com/liruiw/GA-DDPG) writes a folder of files such as
`DDPG_actor_PandaYCBEnv_latest` and `DDPG_state_feat_PandaYCBEnv_latest`: dictionaries whose `net`
holds the weights of the actor's head and of the encoders. Critic and optimizers are not read.
"""

import hashlib
import pickle
import re
from collections.abc import Mapping
from pathlib import Path

from torch import Tensor, nn

from handover_marl.errors import DataFormatError, DataNotFoundError, UnsafeFileError
from handover_marl.execution.files import shorten_text
from handover_marl.execution.reading import read_plain_file
from handover_marl.learning.networks.gaddpg_network import GaddpgNetwork
from handover_marl.learning.networks.weights import check_finite_weights, load_tensors, untrained_networks

_ACTOR, _FEATURES = "_actor_", "_state_feat_"
# Names of the encoder's parts in the original code, which wraps its encoders for several GPUs.
_STAGES, _DENSE = re.compile(r"^(module\.)?encoder\.0\."), re.compile(r"^(module\.)?encoder\.1\.")


def read_gaddpg_checkpoint(path: str | Path) -> tuple[GaddpgNetwork, str]:
    """Read the network of an original checkpoint.

    Args:
        path: Folder of the checkpoint, or one of its two files.

    Returns:
        The network in evaluation mode on the CPU, and a hash of both files (8 hexadecimal digits).

    Raises:
        DataNotFoundError: The checkpoint or one of its files does not exist.
        DataFormatError: A file is damaged, or contains weights of another network.
        UnsafeFileError: A file contains Python objects other than tensors and plain numbers.
    """
    actor, features = _find_files(Path(path).expanduser())
    contents = [_read_bytes(file) for file in (actor, features)]
    with untrained_networks():
        network = GaddpgNetwork()
    _load_weights(actor, network.policy, _parse_weights(actor, contents[0]))
    _load_weights(features, network.features, _rename_encoder(_parse_weights(features, contents[1])))
    return network.eval(), hashlib.sha256(b"".join(contents)).hexdigest()[:8]


def _find_files(path: Path) -> tuple[Path, Path]:
    """Return the files of the actor's head and of the encoders."""
    if path.is_dir():
        actors = sorted(file for file in path.iterdir() if _ACTOR in file.name)
        chosen = [file for file in actors if file.name.endswith("_latest")] or actors
        if len(chosen) != 1:
            found = ", ".join(file.name for file in chosen) or "none"
            raise DataNotFoundError(
                f"{path}: folder must contain one file named {_ACTOR!r}, got {found}; pass the path of one file"
            )
        path = chosen[0]
    name = path.name.replace(_FEATURES, _ACTOR)
    if _ACTOR not in name:
        raise DataNotFoundError(
            f"{path}: a checkpoint of GA-DDPG is a folder with files named like DDPG{_ACTOR}PandaYCBEnv_latest and "
            f"DDPG{_FEATURES}PandaYCBEnv_latest, or one of these files"
        )
    return path.with_name(name), path.with_name(name.replace(_ACTOR, _FEATURES))


def _read_bytes(file: Path) -> bytes:
    try:
        return read_plain_file(file)
    except OSError as error:
        raise DataNotFoundError(
            f"{file}: cannot read one of the two files of a checkpoint ({error.strerror or error})"
        ) from error
    except ValueError as error:
        raise DataFormatError(f"{file}: cannot read one of the two files of a checkpoint ({error})") from error


def _parse_weights(file: Path, content: bytes) -> dict[str, Tensor]:
    try:
        found = load_tensors(content)
    except pickle.UnpicklingError as error:
        raise UnsafeFileError(f"{file}: holds more than weights and was not loaded ({shorten_text(error)})") from error
    except Exception as error:  # Damaged files raise exceptions of many types.
        raise DataFormatError(f"{file}: not a checkpoint of PyTorch ({shorten_text(error)})") from error
    net = found.get("net") if isinstance(found, Mapping) else None
    if not isinstance(net, Mapping) or not all(isinstance(value, Tensor) for value in net.values()):
        raise DataFormatError(f"{file}: not a checkpoint of GA-DDPG, which has weights by name under 'net'")
    return {str(name): value for name, value in net.items()}


def _rename_encoder(weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return the weights of the actor's encoder under the names of `PointNetPlusPlus`."""
    renamed: dict[str, Tensor] = {}
    for pattern, part in ((_STAGES, "stages."), (_DENSE, "dense.")):
        renamed |= {pattern.sub(part, name): value for name, value in weights.items() if pattern.match(name)}
    return renamed


def _load_weights(file: Path, module: nn.Module, weights: dict[str, Tensor]) -> None:
    try:
        module.load_state_dict(weights)
    except RuntimeError as error:
        raise DataFormatError(f"{file}: weights of another network ({shorten_text(error)})") from error
    check_finite_weights(file, module)
