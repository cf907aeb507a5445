"""Grasps out of a view: a network that tells, at many points of an object, the grasp there and how good it is.

Goals that one network regresses for a whole view are means of grasps that are far apart; told point by point, as in
Contact-GraspNet (Sundermeyer et al., ICRA 2021), each point has a grasp near it, and the best of them is chosen.
Clouds are in the hand link's frame (m), of object and person's hand together.
"""

import itertools
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple, TypeVar

import torch
import torch.nn.functional as func
from torch import Tensor, nn

from handover_marl.networks.own_weights import KeptNetwork
from handover_marl.networks.point_sampling import greatest

#: Distance of the point between the pads from the hand link's origin, along its z axis (m).
PADS = 0.1
# Coordinates are multiplied by this so that numbers are near one (1/m), and those of the whole cloud by this.
_NEAR, _FAR = 20.0, 2.0
_TURN = 6

_Self = TypeVar("_Self", bound="GraspNetwork")


@dataclass(frozen=True)
class GraspNetworkConfig:
    """Widths of the network.

    Attributes:
        points: Numbers of one point.
        group: Of a group of points.
        whole: Of the whole cloud.
        grasp: Of the layers that tell a grasp.
        hand: Whether points of the person's hand are seen.
        groups: Sizes of the groups of points about a center, from fine to coarse; without, what is told at a point is
            told from it and the whole cloud alone, as PointNet does.
    """

    points: int = 128
    group: int = 128
    whole: int = 256
    grasp: int = 256
    hand: bool = True
    groups: tuple[int, ...] = (8, 32)


class Grasps(NamedTuple):
    """What the network tells of B views, at C centers each.

    Attributes:
        quality: (B, C) logits of how good the grasp at a center is.
        places: (B, C, 3) points between the pads (m).
        turns: (B, C, 3, 3) orientations of the hand link; half a turn about z is the same grasp.
        middle: (B, 3) of the object, seen and unseen (m).
        motion: (B, 3) what the object moves in the time that it was trained for (m).
    """

    quality: Tensor
    places: Tensor
    turns: Tensor
    middle: Tensor
    motion: Tensor


class Views(NamedTuple):
    """B clouds.

    Attributes:
        objects: (B, N, 3) points of the object (m).
        hands: (B, M, 3) points of the person's hand (m), of which
        seen: (B, M) some count.
        centers: (B, C) at which of the object's points grasps are wanted.
        velocity: (B, 3) of the object (m/s).
    """

    objects: Tensor
    hands: Tensor
    seen: Tensor
    centers: Tensor
    velocity: Tensor


def _layers(*widths: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for before, after in itertools.pairwise(widths):
        layers += [nn.Linear(before, after), nn.ReLU()]
    return nn.Sequential(*layers)


class GraspNetwork(KeptNetwork):
    """See the module. What it says depends on the sets of points, neither on their order nor on repeats.

    Args:
        config: Its widths.
    """

    kind = "vision"

    def __init__(self, config: GraspNetworkConfig = GraspNetworkConfig()) -> None:
        super().__init__()
        self.config = config
        self.points = _layers(7, 64, config.points)
        self.whole = nn.ModuleList([_layers(config.points, config.whole) for _ in range(2)])
        self.mixed = _layers(2 * config.whole + 3, config.whole, config.whole)
        # Of a group's points relative to its center: linear, so that each point is looked at once.
        self.inner = nn.ModuleList([nn.Linear(config.points, config.group) for _ in config.groups])
        self.outer = nn.ModuleList([nn.Linear(3, config.group, bias=False) for _ in config.groups])
        width = config.points + len(config.groups) * config.group + config.whole + 3
        self.grasp = nn.Sequential(_layers(width, config.grasp, config.grasp), nn.Linear(config.grasp, 4 + _TURN))
        self.rest = nn.Sequential(_layers(config.whole, config.grasp), nn.Linear(config.grasp, 6))

    def settings(self) -> dict[str, Any]:
        """Its widths."""
        return asdict(self.config)

    @classmethod
    def of(cls: "type[_Self]", settings: dict[str, Any]) -> "_Self":
        """An untrained one."""
        return cls(GraspNetworkConfig(**(settings | {"groups": tuple(settings["groups"])})))

    def forward(self, views: Views) -> Grasps:
        """Grasps at the centers of some views."""
        seen = views.seen if self.config.hand else torch.zeros_like(views.seen)
        middle = views.objects.mean(dim=1, keepdim=True)
        places = torch.cat([views.objects, views.hands], dim=1)
        from_middle = _NEAR * 0.5 * (places - middle)
        kind = torch.zeros_like(places[..., :1])
        kind[:, views.objects.shape[1] :] = 1.0
        points = self.points(torch.cat([from_middle, _FAR * places, kind], dim=-1))
        there = torch.cat([torch.ones_like(views.objects[..., 0], dtype=torch.bool), seen], dim=1)
        whole = self._whole(points, there, views)
        centers = views.objects.gather(1, views.centers[..., None].expand(-1, -1, 3))
        features = [
            points.gather(1, views.centers[..., None].expand(-1, -1, points.shape[-1])),
            *self._groups(points, places - middle, there, centers - middle),
            whole[:, None].expand(-1, centers.shape[1], -1),
            0.5 * _NEAR * (centers - middle),
        ]
        told = self.grasp(torch.cat(features, dim=-1)).float()
        rest = self.rest(whole).float()
        return Grasps(
            told[..., 0],
            centers + told[..., 1:4] / _NEAR,
            turns_of(told[..., 4:]),
            middle[:, 0] + rest[:, :3] / _NEAR,
            rest[:, 3:] / _NEAR,
        )

    def _whole(self, points: Tensor, there: Tensor, views: Views) -> Tensor:
        """(B, whole) of the whole cloud."""
        n_object = views.objects.shape[1]
        item = self.whole[0](points[:, :n_object]).max(dim=1).values
        hand = self.whole[1](points[:, n_object:]) * there[:, n_object:, None]
        mixed: Tensor = self.mixed(torch.cat([item, hand.max(dim=1).values, views.velocity], dim=-1))
        return mixed

    def _groups(self, points: Tensor, places: Tensor, there: Tensor, centers: Tensor) -> list[Tensor]:
        """(B, C, group) of what is near centers (B, C, 3), for each size of group; places are small numbers."""
        if not self.config.groups:
            return []
        with torch.no_grad():
            away = torch.cdist(centers, places).masked_fill(~there[:, None], torch.inf)
            near = away.topk(max(self.config.groups), dim=-1, largest=False).indices
        found = []
        for count, inner, outer in zip(self.config.groups, self.inner, self.outer, strict=True):
            # A neighbour that is not there is far away; there are more points of the object than neighbours.
            around = greatest(inner(points) + outer(_NEAR * places), near[..., :count])
            found.append(func.relu(around - outer(_NEAR * centers)))
        return found


def turns_of(six: Tensor) -> Tensor:
    """(..., 3, 3) rotations whose first and last columns are near two vectors (..., 6) (Zhou et al., CVPR 2019)."""
    ahead = func.normalize(six[..., :3], dim=-1)
    side = six[..., 3:] - (ahead * six[..., 3:]).sum(dim=-1, keepdim=True) * ahead
    across = func.normalize(side, dim=-1)
    return torch.stack([torch.linalg.cross(across, ahead, dim=-1), across, ahead], dim=-1)
