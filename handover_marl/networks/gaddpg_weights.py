"""The original authors' GA-DDPG checkpoints, read without running anything in them.

Their code (github.com/liruiw/GA-DDPG) writes a folder of files such as `DDPG_actor_PandaYCBEnv_latest` and
`DDPG_state_feat_PandaYCBEnv_latest`: dictionaries whose `net` are the weights of the head, and of both encoders, the
critic's among them, which is left out. Optimizers are left alone.
"""

import hashlib
import io
import pickle
import re
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from handover_marl.errors import DataFormatError, DataNotFoundError, UnsafeFileError
from handover_marl.files import brief
from handover_marl.networks.gaddpg_network import GaddpgNetwork

_ACTOR, _FEATURES = "_actor_", "_state_feat_"
_LARGEST = 500_000_000  # bytes
# The original's names of the encoder's parts; it wraps its encoders for several GPUs.
_STAGES, _DENSE = re.compile(r"^(module\.)?encoder\.0\."), re.compile(r"^(module\.)?encoder\.1\.")


def read_weights(path: str | Path) -> tuple[GaddpgNetwork, str]:
    """The network of a checkpoint.

    Args:
        path: Its folder, or one of its files beside the others.

    Returns:
        The network, on the CPU, and a short hash of its two files.

    Raises:
        DataNotFoundError: There is no such checkpoint, or half of it is missing.
        DataFormatError: A file is damaged, or the weights are of another network.
        UnsafeFileError: A file asks for more than tensors and plain numbers.
    """
    actor, features = _files(Path(path).expanduser())
    contents = [_content(file) for file in (actor, features)]
    network = GaddpgNetwork()
    _load(actor, network.policy, _weights(actor, contents[0]))
    _load(features, network.features, _encoder(_weights(features, contents[1])))
    return network.eval(), hashlib.sha256(b"".join(contents)).hexdigest()[:8]


def _files(path: Path) -> tuple[Path, Path]:
    """The actor's file and that of the encoders."""
    if path.is_dir():
        actors = sorted(file for file in path.iterdir() if _ACTOR in file.name)
        chosen = [file for file in actors if file.name.endswith("_latest")] or actors
        if len(chosen) != 1:
            found = ", ".join(file.name for file in chosen) or "none"
            raise DataNotFoundError(
                f"{path}: one checkpoint is wanted, but of files with {_ACTOR!r} there are {found}; name one of them"
            )
        path = chosen[0]
    name = path.name.replace(_FEATURES, _ACTOR)
    if _ACTOR not in name:
        raise DataNotFoundError(
            f"{path}: a checkpoint of GA-DDPG is a folder with files named like DDPG{_ACTOR}PandaYCBEnv_latest and "
            f"DDPG{_FEATURES}PandaYCBEnv_latest, or one of these files"
        )
    return path.with_name(name), path.with_name(name.replace(_ACTOR, _FEATURES))


def _content(file: Path) -> bytes:
    try:
        if file.stat().st_size > _LARGEST:
            raise DataFormatError(f"{file}: checkpoints have at most {_LARGEST // 1_000_000} MB")
        return file.read_bytes()
    except OSError as error:
        raise DataNotFoundError(
            f"{file}: cannot read this half of a checkpoint, which is two files ({error.strerror or error})"
        ) from error


def _weights(file: Path, content: bytes) -> dict[str, Tensor]:
    try:
        found = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        raise UnsafeFileError(f"{file}: it holds more than weights and was not loaded ({brief(error)})") from error
    except Exception as error:  # what damaged files raise has no end
        raise DataFormatError(f"{file}: no checkpoint of PyTorch ({brief(error)})") from error
    net = found.get("net") if isinstance(found, Mapping) else None
    if not isinstance(net, Mapping) or not all(isinstance(value, Tensor) for value in net.values()):
        raise DataFormatError(f"{file}: no checkpoint of GA-DDPG, which has weights by name under 'net'")
    return {str(name): value for name, value in net.items()}


def _encoder(weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """The actor's encoder by this library's names."""
    named: dict[str, Tensor] = {}
    for pattern, part in ((_STAGES, "stages."), (_DENSE, "dense.")):
        named |= {pattern.sub(part, name): value for name, value in weights.items() if pattern.match(name)}
    return named


def _load(file: Path, module: nn.Module, weights: dict[str, Tensor]) -> None:
    try:
        module.load_state_dict(weights)
    except RuntimeError as error:
        raise DataFormatError(f"{file}: weights of another network ({brief(error)})") from error
    if not all(bool(torch.isfinite(value).all()) for value in module.state_dict().values()):
        raise DataFormatError(f"{file}: some of its numbers are not finite")
