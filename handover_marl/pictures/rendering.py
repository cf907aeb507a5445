"""Pictures and films of handovers, drawn without a screen."""

import importlib.util
import io
import os
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image
from rich.console import Console
from rich.progress import Progress
from typing_extensions import Unpack

from handover_marl.config import CameraConfig
from handover_marl.episode.episode import Episode
from handover_marl.episode.play import play
from handover_marl.episode.watchers import Watcher
from handover_marl.errors import OptionError, ResultsError, UnknownNameError
from handover_marl.files import write_atomically
from handover_marl.options import shows
from handover_marl.pictures.replay_page import replay_facts, replay_page
from handover_marl.pictures.replay_recorder import ReplayRecorder
from handover_marl.pictures.replay_stage import check_replay
from handover_marl.pictures.wrist_picture import WristPicture
from handover_marl.policies.reference import PolicyLike, policy_reference
from handover_marl.run import OF_SEVERAL, REPLAY, Execution, Run, SceneOptions, describe
from handover_marl.sim.renderers import chosen_renderer
from handover_marl.sim.scene_pictures import check_drawing

Picture = npt.NDArray[np.uint8]

_NEEDED: dict[str, tuple[str, ...]] = {".png": (), ".gif": (), ".mp4": ("imageio", "imageio_ffmpeg"), ".html": ()}

#: What a picture can show.
VIEWS = ("outside", "wrist")
#: Kinds of files, by suffix.
SUFFIXES = tuple(_NEEDED)

_FILM_PERIOD_MS = 80
_SHEET_COLUMNS = {"outside": 3, "wrist": 1}
_BLANK_AFTER_MS = 500


class Film(Watcher):
    """Takes pictures of an episode at chosen steps.

    Args:
        times: Steps, ascending.
        draw: Draws the present moment.
        progress: Whether to show a progress bar, on stderr.
        with_end: Whether to show how it ended, too.

    Attributes:
        pictures: (height, width, 3) each.
    """

    def __init__(
        self,
        times: Sequence[int],
        draw: Callable[[Episode], Picture],
        progress: bool = False,
        with_end: bool = True,
    ) -> None:
        self.pictures: list[Picture] = []
        self._times, self._draw, self._with_end = set(times), draw, with_end
        self._progress = Progress(console=Console(stderr=True), disable=not progress, transient=False)
        self._bar = self._progress.add_task("drawing", total=max(len(self._times), 1))

    def started(self, episode: Episode) -> None:
        """The first picture, if wanted."""
        self._progress.start()
        self.stepped(episode)

    def stepped(self, episode: Episode) -> None:
        """A picture, if wanted now."""
        if episode.steps in self._times:
            self.pictures.append(self._draw(episode))
            self._progress.advance(self._bar)

    def ended(self, episode: Episode) -> None:
        """The last picture."""
        if self._with_end and episode.steps not in self._times:
            self.pictures.append(self._draw(episode))
        self._progress.update(self._bar, completed=max(len(self._times), 1))
        self._progress.stop()


@shows(Run, Execution, without=("setup", "split", "scenes", "config", *OF_SEVERAL))
def render_scene(
    scene_id: int,
    out: str | os.PathLike[str],
    *,
    receiver: PolicyLike | None = None,
    giver: PolicyLike = REPLAY,
    key_frames: int = 6,
    camera: CameraConfig | None = None,
    view: str = "outside",
    **options: Unpack[SceneOptions],
) -> Path:
    """Draw a scene, or the episode that policies make of it.

    Args:
        scene_id: The scene, 0 to 999.
        out: Where to write: `.png` is a sheet of key frames, `.gif` and `.mp4` are films, `.html` is a page that plays
            the episode in three dimensions.
        receiver: As in `benchmark`; None shows the person with the robot at rest.
        giver: As in `evaluate_pair`.
        key_frames: Pictures on a sheet, evenly over the episode, its start and its end among them.
        camera: Where to look from.
        view: "outside", or "wrist": the same beside depth, segmentation and cloud of the robot's wrist camera.
        options: `dataset`, `data_dir`, `physics`, `robot`, `renderer`, `geometry`, `imperfections`, `seed`, `progress`
            and `trust`, as `handover_marl.Run` and `handover_marl.Execution` say.

    Returns:
        The file that was written.

    Raises:
        OptionError: The file's suffix is unknown, a library for it is not installed, or a size is impossible.
        ResultsError: The file cannot be written; noticed before drawing.
        UnknownNameError: There is no such view; or as for a benchmark, and so are
        SceneError, DataNotFoundError, DataFormatError.
    """
    path = checked_path(out, SUFFIXES)
    if view not in VIEWS:
        raise UnknownNameError("view", view, VIEWS)
    replay = path.suffix.lower() == ".html"
    if replay:
        check_replay()
        if view != "outside":
            raise OptionError(f"a replay (.html) is looked at from outside, not through view={view!r}")
    else:
        check_drawing(f"drawing {path.name}")
    draw = _drawing(view, camera or CameraConfig())
    if isinstance(key_frames, bool) or not isinstance(key_frames, int) or key_frames < 1:
        raise OptionError(f"key_frames={key_frames!r}: a sheet needs a whole number of pictures, one or more")
    run, how = describe("s0", options, receiver="hold" if receiver is None else receiver, giver=giver)
    data = run.open_dataset()
    named = [policy_reference(agent, getattr(run, agent), how.trust) for agent in ("receiver", "giver")]
    robot, person = (reference.make(data, run.config, run.setup) for reference in named)
    scene = data.scene(scene_id)
    chosen_renderer(run.renderer, run.physics, installed=view == "wrist")
    episode = Episode(run.physics, run.config, sight=run.camera)

    def filmed(times: Sequence[int], until: int | None, with_end: bool = True) -> Film:
        film = Film(times, draw, how.progress, with_end)
        episode.reset(scene)
        play(episode, robot, person, seed=run.seed, until=until, watchers=[film])
        return film

    until = scene.n_frames + _BLANK_AFTER_MS if receiver is None else None
    if replay:
        recorder = ReplayRecorder(robot)
        episode.reset(scene)
        play(episode, robot, person, seed=run.seed, until=until, watchers=[recorder])
        labelled = [reference.resolved(data, run.config, run.setup) for reference in named]
        played = replace(run, dataset=data.name, receiver=labelled[0], giver=labelled[1])
        picture = replay_page(recorder.log, replay_facts(played, data.models_in_words(scene_id)), camera).encode()
    elif path.suffix.lower() == ".png":
        # Played twice: only then is it known how long it takes, and so when the key frames are.
        end = until
        if end is None:
            episode.reset(scene)
            play(episode, robot, person, seed=run.seed)
            end = episode.steps
        times = np.linspace(0, end, key_frames).round().astype(int).tolist()
        picture = _sheet(filmed(times, until, False).pictures, _SHEET_COLUMNS[view])
    else:
        times = list(range(0, until or run.config.protocol.horizon_steps, _FILM_PERIOD_MS))
        picture = _encode(filmed(times, until).pictures, path.suffix.lower())
    episode.close()
    write_atomically(path, picture)
    return path


def _drawing(view: str, camera: CameraConfig) -> Callable[[Episode], Picture]:
    if view == "wrist":
        return WristPicture(camera)
    return lambda episode: episode.render(camera)


def checked_path(out: str | os.PathLike[str], suffixes: Sequence[str]) -> Path:
    """Where a picture goes: a file of a known kind in a folder that can be written to, made if need be.

    Raises:
        OptionError: The kind is not known, or needs a library that is not installed.
        ResultsError: The folder cannot be made or written to.
    """
    try:
        path = Path(out).expanduser()
    except (TypeError, RuntimeError) as error:
        raise OptionError(f"out={out!r} must be a path ({error})") from error
    suffix = path.suffix.lower()
    if suffix not in suffixes:
        raise OptionError(f"{path}: cannot tell what to draw from {path.suffix!r}; end it in {', '.join(suffixes)}")
    for module in _NEEDED.get(suffix, ()):
        if importlib.util.find_spec(module) is None:
            raise OptionError(f"{suffix} files need {module}: pip install 'handover-marl[render]'")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # Rights alone do not tell: some file systems take no files whoever asks.
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except (OSError, ValueError) as error:
        raise ResultsError(f"cannot write {path} ({error}); choose another place") from error
    if path.is_dir():
        raise ResultsError(f"cannot write {path}; choose another place")
    return path


def _sheet(pictures: list[Picture], columns: int) -> bytes:
    rows = [pictures[start : start + columns] for start in range(0, len(pictures), columns)]
    blank = np.full_like(pictures[0], 255)
    width = min(columns, len(pictures))
    full = [np.concatenate([*row, *[blank] * (width - len(row))], axis=1) for row in rows]
    image = Image.fromarray(np.concatenate(full))
    stream = io.BytesIO()
    image.save(stream, format="PNG", optimize=True)
    return stream.getvalue()


def _encode(pictures: list[Picture], suffix: str) -> bytes:
    stream = io.BytesIO()
    if suffix == ".gif":
        first, *rest = [Image.fromarray(picture).quantize(64) for picture in pictures]
        first.save(
            stream,
            format="GIF",
            save_all=True,
            append_images=rest,
            duration=_FILM_PERIOD_MS,
            loop=0,
            optimize=True,
        )
        return stream.getvalue()
    import imageio.v3 as imageio

    return bytes(
        imageio.imwrite("<bytes>", np.stack(pictures), extension=".mp4", fps=1000 / _FILM_PERIOD_MS, codec="libx264")
    )
