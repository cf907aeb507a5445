"""Commands `handover-marl scenes ...`, which build, check and show custom scenes."""

from typing import Annotated, Literal

import tyro

from handover_marl.cli.options import Folder, Progress, Workers
from handover_marl.evaluation.rendering import render_scene
from handover_marl.execution.files import write_atomically
from handover_marl.execution.options import check_path, require_modules
from handover_marl.visualization.pictures import draw_recording

_Offset = Annotated[str | None, tyro.conf.arg(metavar="x,y,z,qx,qy,qz,qw")]
_Names = Annotated[str | None, tyro.conf.arg(metavar="NAME,...")]


def add_object(
    folder: Folder,
    name: str,
    mesh: Annotated[str, tyro.conf.arg(metavar="FILE")],
    /,
    unit: Literal["m", "cm", "mm", "inch"] = "m",
    scale: float = 1.0,
    mass: float | None = None,
    density: float | None = None,
    friction: float = 0.9,
    color: str = "blue",
    concavity: float = 0.05,
    grasps: int = 60,
    seed: int = 0,
    workers: Workers = None,
    progress: Progress = True,
) -> None:
    """Add an object class from a triangle mesh, with convex parts and robot grasps.

    Args:
        folder: Folder of custom scenes; created if it does not exist.
        name: Class name of the object.
        mesh: Mesh file of any format that trimesh reads (STL, OBJ, PLY, ...).
        unit: Unit of length in the mesh file.
        scale: Factor by which the mesh is scaled, in addition to the conversion of its unit.
        mass: Mass (kg); default: from the density.
        density: Density (kg/m^3); default: 300, a half-filled plastic bottle.
        friction: Lateral friction coefficient.
        color: Color in images, a name of the library's palette.
        concavity: Threshold of the convex decomposition with CoACD, 0.01 (many convex parts) to 1 (one).
        grasps: Number of robot grasps to find in simulation; 0 for none.
        seed: Random seed of the grasps.
    """
    from handover_marl.assets.building.custom_scenes import CustomSceneFolder, MeshConfig

    config = MeshConfig(unit, scale, mass, density, friction, color, concavity)
    item = CustomSceneFolder(folder).add_object(
        name, mesh, config, grasps=grasps, seed=seed, workers=workers, progress=progress
    )
    print(item, flush=True)


def add_motion(
    folder: Folder,
    motion: Annotated[str, tyro.conf.arg(metavar="FILE")],
    /,
    object: str,  # noqa: A002 - the name of the option
    subject: str,
    recording: str | None = None,
    side: Literal["right", "left"] = "right",
    hand: Annotated[int | Literal["none"], tyro.conf.arg(metavar="{1..10,none}")] = 6,
    others: _Names = None,
    frame: Annotated[str, tyro.conf.arg(metavar="{world,table}|x,y,z,qx,qy,qz,qw")] = "world",
    object_offset: _Offset = None,
    wrist_offset: _Offset = None,
    length: Literal["m", "cm", "mm"] = "m",
    time: Literal["s", "ms", "us", "ns"] = "s",
    quaternion: Literal["xyzw", "wxyz"] = "xyzw",
    fingers: Literal["euler", "rotvec"] = "euler",
    max_gap: float = 0.2,
    preview: Annotated[str | None, tyro.conf.arg(metavar="FILE.png")] = None,
) -> None:
    """Add a scene: the recorded motion of an object, a wrist and other objects.

    Args:
        folder: Folder of custom scenes.
        motion: CSV or NPZ file of poses at any rate, or a CSV file of OptiTrack's Motive.
        object: Class of the object that is handed over: a class of the folder or a YCB class.
        subject: Name of the person.
        recording: Name of the recording; default: the number of the scene.
        side: Hand with which the person gives the object.
        hand: Number of the shipped model of a person's hand, or none for a scene without a hand.
        others: Classes of the other objects, whose poses must be in the file, separated by commas.
        frame: Frame of the poses: world, table, or the pose of another frame in the world.
        object_offset: Pose of the object's frame in the recorded frame (of its markers): xyz (m) and quaternion xyzw.
        wrist_offset: Pose of the wrist's frame in the recorded frame, in the same form.
        length: Unit of positions.
        time: Unit of times.
        quaternion: Order of quaternions in NPZ files.
        fingers: Form of finger angles in the file: intrinsic XYZ Euler angles or rotation vectors.
        max_gap: Largest time without recorded poses (s) that is filled by interpolation.
        preview: Image of the recorded paths (.png), written before they are compared with table and robot.
    """
    from handover_marl.assets.building.custom_scenes import CustomSceneFolder, MotionConfig
    from handover_marl.assets.building.custom_scenes.motion_tables import read_motion_table

    config = MotionConfig(frame, length, time, quaternion, fingers, max_gap, object_offset, wrist_offset)
    if preview is not None:
        require_modules("the preview", "plot", "matplotlib")
        table = read_motion_table(motion, config)
        wrist = {} if table.wrist is None else {"wrist": table.wrist}
        write_atomically(check_path("preview", preview), draw_recording({**table.bodies, **wrist}))
    scene = CustomSceneFolder(folder).add_motion(
        motion,
        object,
        subject,
        config,
        recording=recording,
        side=side,
        hand=None if hand == "none" else hand,
        others=tuple(others.split(",")) if others else (),
    )
    print(scene, flush=True)


def add_split(
    folder: Folder,
    name: str,
    /,
    by: Literal["object", "person", "random"] = "random",
    val: str = "0.2",
    test: str = "0.2",
    seed: int = 0,
) -> None:
    """Divide all scenes into train, val and test.

    Args:
        folder: Folder of custom scenes.
        name: Name of the setup.
        by: Division by object, by person, or at random.
        val: Share of the val split, or names of its objects or persons, separated by commas. Write a comma after a
            single name that is a number.
        test: Share of the test split, or names of its objects or persons.
        seed: Random seed.
    """
    from handover_marl.assets.building.custom_scenes import CustomSceneFolder

    setup = CustomSceneFolder(folder).add_split(name, by, val=_parse_share(val), test=_parse_share(test), seed=seed)
    print(f"{name}: " + ", ".join(f"{split} {len(numbers)} scenes" for split, numbers in setup.items()), flush=True)


def check(folder: Folder, /) -> None:
    """Check all files of a folder of custom scenes and print its objects, number of scenes and setups.

    Args:
        folder: Folder of custom scenes.
    """
    from handover_marl.assets.building.custom_scenes import CustomSceneFolder

    dataset = CustomSceneFolder(folder).check()
    advice = f"Use it: --dataset own:{dataset.folder}" if dataset.n_scenes else "Add scenes with scenes add-motion."
    print(f"{dataset.content}\nNo faults. {advice}", flush=True)


def preview(
    folder: Folder, scene: int, /, out: Annotated[str, tyro.conf.arg(metavar="FILE")], progress: Progress = True
) -> None:
    """Render a scene with a robot that does not move, as a 3D replay page, an image or a video.

    Args:
        folder: Folder of custom scenes.
        scene: Number of the scene.
        out: Output file: .html, .png, .gif or .mp4.
    """
    print(render_scene(scene, out, dataset=f"own:{folder}", physics="fast", progress=progress), flush=True)


def _parse_share(text: str) -> float | tuple[str, ...]:
    try:
        return float(text)
    except ValueError:
        return tuple(name for name in text.split(",") if name)
