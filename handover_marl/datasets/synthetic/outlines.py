"""Outlines of the shipped objects, as far as placing them needs: the corners of their hulls."""

from functools import cache
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull

from handover_marl.assets.object_models import object_urdf
from handover_marl.models.obj_files import read_obj


@cache
def hull_corners(object_name: str) -> npt.NDArray[np.float64]:
    """(n, 3) corners (m) of the convex hull of an object's collision parts, in the object's frame."""
    urdf = object_urdf(object_name)
    meshes = {element.get("filename") for element in ElementTree.parse(urdf).iterfind(".//collision/geometry/mesh")}
    corners = np.concatenate([read_obj(urdf.parent / str(name)).vertices for name in sorted(map(str, meshes))])
    hull: npt.NDArray[np.float64] = corners[np.sort(ConvexHull(corners).vertices)]
    return hull
