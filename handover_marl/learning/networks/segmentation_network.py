"""Network that segments images of the wrist camera into object, person's hand, other objects and the rest.

The first part is a small U-Net (Ronneberger et al., MICCAI 2015) on blocks of 4 x 4 pixels, which is ten times as fast
as one on pixels. The second part classifies the 3D points of the pixels that the first one assigns to object or hand.
"""

import torch
import torch.nn.functional as func
from torch import Tensor, nn

from handover_marl.learning.networks.point_segmentation_network import PointSegmentationNetwork
from handover_marl.learning.networks.weights import SavedNetwork

#: Number of classes: the rest (robot, table, ground), the object to be given, the other objects, the person's hand.
N_CLASSES = 4
_BLOCK = 4  # side of a block (pixels)
_WIDTHS = (24, 40, 64, 96)  # channels at resolutions of 1/4, 1/8, 1/16 and 1/32
_N_INPUTS = 5
# Middle of the range of heights in the world (m), and factor of heights and depths (1/m).
_MIDDLE_HEIGHT, _SCALE = 1.1, 2.0


def _convolve(n_inputs: int, n_outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(n_inputs, n_outputs, 3, padding=1, bias=False), nn.BatchNorm2d(n_outputs), nn.ReLU(inplace=True)
    )


class SegmentationNetwork(SavedNetwork):
    """Convolutional network that classifies the pixels of images, whose sides must be multiples of 32 pixels.

    Attributes:
        points: Network that classifies points of object and hand; `forward` does not evaluate it.
    """

    kind = "segmentation"

    def __init__(self) -> None:
        super().__init__()
        inputs = (_N_INPUTS * _BLOCK**2, *_WIDTHS)
        pairs = list(zip(inputs[:-1], _WIDTHS, strict=True))
        self.down = nn.ModuleList([nn.Sequential(_convolve(a, b), _convolve(b, b)) for a, b in pairs])
        self.up = nn.ModuleList([_convolve(a + b, a) for a, b in pairs[:0:-1]])
        self.head = nn.Conv2d(_WIDTHS[0], N_CLASSES * _BLOCK**2, 1)
        self.points = PointSegmentationNetwork(N_CLASSES)

    def forward(self, rgb: Tensor, depth: Tensor, height: Tensor) -> Tensor:
        """Return the logits (B, 4, h, w) of the classes of each pixel of B images.

        Args:
            rgb: (B, h, w, 3) red, green and blue from 0 to 255.
            depth: (B, h, w) depth along the viewing axis (m).
            height: (B, h, w) height of the pixels' points in the world (m).
        """
        colors = rgb.permute(0, 3, 1, 2).float() / 127.5 - 1.0
        space = torch.stack([depth.float() - 0.5, height.float() - _MIDDLE_HEIGHT], dim=1)
        x = func.pixel_unshuffle(torch.cat([colors, (_SCALE * space).clamp(-2.0, 2.0)], dim=1), _BLOCK)
        skipped: list[Tensor] = []
        for number, block in enumerate(self.down):
            x = block(func.max_pool2d(x, 2) if number else x)
            skipped.append(x)
        skipped.pop()
        for block in self.up:
            x = block(torch.cat([skipped.pop(), func.interpolate(x, scale_factor=2.0)], dim=1))
        logits: Tensor = func.pixel_shuffle(self.head(x), _BLOCK)
        return logits
