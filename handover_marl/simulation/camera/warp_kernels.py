"""Kernels of the ray caster on a device; see `warp_camera.WarpCamera`.

Pixels are numbered row by row. Poses are in the camera's frame: x right, y down, z ahead (m).
"""

import warp

from handover_marl.simulation.camera.images import SegmentationLabel
from handover_marl.simulation.camera.optics import (
    AMBIENT,
    BACK_FACE_OFFSET,
    DIFFUSE,
    GROUND,
    LIGHT,
    MAX_BACK_FACES,
    SKY,
    SPECULAR,
)

_BACK_FACE_OFFSET, _MAX_BACK_FACES = warp.constant(BACK_FACE_OFFSET), warp.constant(MAX_BACK_FACES)
_LIGHT = warp.constant(warp.vec3(*LIGHT))
_AMBIENT, _DIFFUSE, _SPECULAR = map(warp.constant, (AMBIENT, DIFFUSE, SPECULAR))
_SKY, _EVEN, _ODD = (warp.constant(warp.vec3(*map(float, color))) for color in (SKY, *GROUND))
_BACKGROUND = warp.constant(int(SegmentationLabel.BACKGROUND))


@warp.func
def compute_ray(pixel: int, width: int, intrinsics: warp.vec4) -> warp.vec3:
    """Return the direction (3,) of the ray through a pixel in the camera's frame, scaled to z = 1.

    `pixel` counts the image's pixels row by row, `width` is the number of columns, and `intrinsics` are focal lengths
    and principal point (pixels).
    """
    column, row = pixel % width, pixel // width
    right, down = float(column) - intrinsics[2], float(row) - intrinsics[3]
    return warp.vec3(right / intrinsics[0], down / intrinsics[1], 1.0)


@warp.func
def is_near_sphere(ray: warp.vec3, sphere: warp.vec4, near: float, far: float) -> bool:
    """Return whether a ray from depth `near` to `far` (m) may hit a sphere, given by center and radius (m)."""
    center, radius = warp.vec3(sphere[0], sphere[1], sphere[2]), sphere[3]
    if center[2] + radius < near or center[2] - radius > far:
        return False
    return warp.length_sq(warp.cross(center, ray)) <= radius * radius * warp.length_sq(ray)


@warp.struct
class FaceHit:
    """Front face of a mesh that a ray hits first.

    Attributes:
        depth: Depth of the hit (m).
        face: Number of the face; -1 without a hit.
        normal: Outward unit normal of the face in the mesh's frame.
        weights: Barycentric coordinates of the hit: weights of the face's second and third vertex.
    """

    depth: float
    face: int
    normal: warp.vec3
    weights: warp.vec2


@warp.func
def cast_ray(
    mesh: warp.uint64, rotation: warp.mat33, origin: warp.vec3, ray: warp.vec3, near: float, far: float
) -> FaceHit:
    """Return the first hit of a ray from the camera on a front face of a mesh, from depth `near` to `far` (m).

    The pose of the mesh in the camera's frame is `rotation` and `origin` (m); `ray` is a direction with z = 1 in that
    frame. Hits on back faces are passed over, up to 32. Without a hit, `face` of the result is -1.
    """
    mesh_from_camera = warp.transpose(rotation)
    start, direction = -(mesh_from_camera * origin), mesh_from_camera * ray
    hit = FaceHit()
    hit.face = -1
    # Warp needs an explicit type for numbers that a loop changes.
    begin, left = warp.float32(near), warp.int32(_MAX_BACK_FACES)
    while left >= 0:
        query = warp.mesh_query_ray(mesh, start + begin * direction, direction, far - begin)
        left -= 1
        if not query.result:
            left = -1
        elif warp.dot(query.normal, direction) < 0.0:
            hit.depth = begin + query.t
            hit.face = query.face
            hit.normal = query.normal
            # Warp gives the weights of the first and the second vertex.
            hit.weights = warp.vec2(query.v, 1.0 - query.u - query.v)
            left = -1
        else:
            # Back faces are invisible: the ray continues behind them.
            begin = begin + query.t + _BACK_FACE_OFFSET
    return hit


@warp.func
def sample_texture(
    corners: warp.array2d[warp.vec2],
    textures: warp.array[warp.vec3i],
    texels: warp.array[warp.vec3ub],
    face: int,
    weights: warp.vec2,
) -> warp.vec3:
    """Return the color (0 to 255) of a face at `weights` of its corners 2 and 3; arrays are as in `render_images`."""
    origin, texture = corners[face, 0], textures[face]
    place = origin + weights[0] * (corners[face, 1] - origin) + weights[1] * (corners[face, 2] - origin)
    column = warp.min(int((place[0] - warp.floor(place[0])) * float(texture[1])), texture[1] - 1)
    row = warp.min(int((place[1] - warp.floor(place[1])) * float(texture[2])), texture[2] - 1)
    texel = texels[texture[0] + row * texture[1] + column]
    return warp.vec3(float(texel[0]), float(texel[1]), float(texel[2]))


@warp.func
def shade(color: warp.vec3, normal: warp.vec3) -> warp.vec3:
    """Return a color (0 to 255), multiplied by the brightness of a face with a unit normal in the world."""
    cosine = warp.dot(normal, _LIGHT)
    height = warp.max(2.0 * cosine * normal[2] - _LIGHT[2], 0.0)
    return (_AMBIENT + _DIFFUSE * warp.max(cosine, 0.0) + _SPECULAR * height * height) * color


@warp.kernel(enable_backward=False)
def render_images(
    meshes: warp.array2d[warp.int64],
    labels: warp.array2d[warp.int64],
    rotations: warp.array2d[warp.mat33],
    origins: warp.array2d[warp.vec3],
    spheres: warp.array2d[warp.vec4],
    first_faces: warp.array2d[warp.int64],
    corners: warp.array2d[warp.vec2],
    textures: warp.array[warp.vec3i],
    texels: warp.array[warp.vec3ub],
    cameras: warp.array[warp.mat33],
    pinholes: warp.array[warp.vec3],
    label_bits: int,
    has_ground: bool,
    width: int,
    intrinsics: warp.vec4,
    near: float,
    empty_depth: float,
    depths: warp.array2d[float],
    segmentation: warp.array2d[warp.uint8],
    rgb: warp.array3d[warp.uint8],
) -> None:
    """Render w worlds, one thread per pixel: an unoccluded body with a wanted label, else ground or background.

    Args:
        meshes: Identifiers (w, s) of the meshes; 0 for none.
        labels: Segmentation labels (w, s) of the meshes.
        rotations: Rotation matrices (w, s) of the meshes in the camera's frame.
        origins: Origins (w, s) of the meshes in the camera's frame.
        spheres: Centers and radii (w, s) of bounding spheres of the meshes, in the camera's frame.
        first_faces: Number (w, s) of each mesh's first face among the f faces of all meshes.
        corners: Texture coordinates (f, 3) of the faces' corners; not used for images without colors.
        textures: First texel, width and height (f,) of each face's texture; not used for images without colors.
        texels: Red, green and blue (t,) of all textures; not used for images without colors.
        cameras: Rotation matrices (w,) of the cameras in the world.
        pinholes: Positions (w,) of the cameras in the world.
        label_bits: Labels of the wanted bodies; label i sets bit i.
        has_ground: Whether to draw the ground.
        width: Width of the images (pixels).
        intrinsics: Focal lengths and principal point (pixels).
        near: Distance of the near plane (m).
        empty_depth: Depth of background pixels (m).
        depths: Depth (w, p) of p pixels, an output.
        segmentation: Segmentation labels (w, p), an output.
        rgb: Colors (w, p, 3), an output; (0, 0, 0) for images without colors.
    """
    world, pixel = warp.tid()
    ray = compute_ray(pixel, width, intrinsics)
    camera = cameras[world]
    descent = camera[2, 0] * ray[0] + camera[2, 1] * ray[1] + camera[2, 2] * ray[2]
    ground = warp.float32(empty_depth)
    if descent != 0.0:
        ground = -pinholes[world][2] / descent
    is_ground = ground > near and ground < empty_depth
    best, owner = warp.float32(empty_depth), warp.int32(-1)
    if is_ground:
        best = ground
    first = FaceHit()
    for slot in range(meshes.shape[1]):
        mesh = warp.uint64(meshes[world, slot])
        is_wanted = (label_bits >> int(labels[world, slot])) & 1 == 1
        if is_wanted and mesh != warp.uint64(0) and is_near_sphere(ray, spheres[world, slot], near, best):
            hit = cast_ray(mesh, rotations[world, slot], origins[world, slot], ray, near, best)
            if hit.face >= 0:
                best = hit.depth
                owner = slot
                first = hit
    if owner >= 0:
        # Other bodies are tested only against rays that hit a wanted one.
        for slot in range(meshes.shape[1]):
            mesh = warp.uint64(meshes[world, slot])
            is_other = owner >= 0 and (label_bits >> int(labels[world, slot])) & 1 == 0
            if is_other and mesh != warp.uint64(0) and is_near_sphere(ray, spheres[world, slot], near, best):
                hit = cast_ray(mesh, rotations[world, slot], origins[world, slot], ray, near, best)
                if hit.face >= 0:
                    owner = -1
    color = warp.vec3(_SKY)
    if owner >= 0:
        depths[world, pixel] = best
        segmentation[world, pixel] = warp.uint8(labels[world, owner])
    else:
        segmentation[world, pixel] = warp.uint8(_BACKGROUND)
        if has_ground and is_ground:
            depths[world, pixel] = ground
            place = pinholes[world] + ground * (camera * ray)
            color = warp.vec3(_EVEN)
            if (int(warp.floor(place[0])) + int(warp.floor(place[1]))) % 2 != 0:
                color = warp.vec3(_ODD)
            color = shade(color, warp.vec3(0.0, 0.0, 1.0))
        else:
            depths[world, pixel] = empty_depth
    if rgb.shape[0] > 0:
        if owner >= 0:
            face = int(first_faces[world, owner]) + first.face
            color = sample_texture(corners, textures, texels, face, first.weights)
            color = shade(color, camera * (rotations[world, owner] * first.normal))
        for channel in range(3):
            rgb[world, pixel, channel] = warp.uint8(color[channel])
