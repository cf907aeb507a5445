"""Recording demonstrations: a run on a train split whose episodes are kept as a data set."""

from contextlib import closing

from typing_extensions import Unpack

from handover_marl.benchmarking.runner import evaluate_run
from handover_marl.datasets.splits import check_setup_and_split
from handover_marl.demonstrations.demonstration_scribe import Shown
from handover_marl.demonstrations.demonstration_shelf import DemonstrationShelf
from handover_marl.demonstrations.demonstrations import Demonstrations
from handover_marl.demonstrations.hdf5 import check_hdf5
from handover_marl.episode.observations import ALL, check_observes
from handover_marl.errors import OptionError, UnknownNameError
from handover_marl.options import shows
from handover_marl.policies.reference import PolicyLike
from handover_marl.run import REPLAY, Execution, Run, RunOptions, describe
from handover_marl.sim.renderers import chosen_renderer

#: Which episodes may be kept.
SUCCESS = "success"
KEEPS = (ALL, SUCCESS)
_TRAIN = "train"


@shows(Run, Execution)
def demonstrate(
    setup: str | Run = "s0",
    split: str = _TRAIN,
    receiver: PolicyLike = "reactive",
    giver: PolicyLike = REPLAY,
    *,
    sight: str | None = None,
    observe: str = ALL,
    keep: str = ALL,
    execution: Execution | None = None,
    **options: Unpack[RunOptions],
) -> Demonstrations:
    """Let a receiver play the scenes of a train split and record what there is to see and what it does.

    Args:
        setup: Official setup, "s0" to "s3"; or a whole `handover_marl.Run`.
        split: "train"; there is no other choice.
        receiver: Who demonstrates; as in `benchmark`.
        giver: As in `evaluate_pair`.
        sight: What is recorded of the wrist camera, whatever the receiver itself looks at: "points", "clouds", "images"
            or None.
        observe: "all", or "sight": proprioception and sight alone.
        keep: "all" episodes, with their outcome, or only those that end in "success".
        execution: How to run. Its folder gets the data set, and results and a report as those of `evaluate_pair`; an
            interrupted run goes on there.
        options: The fields of `handover_marl.Run` and `handover_marl.Execution`.

    Raises:
        OptionError: The split is not the train split, there is no folder, or what is needed is not installed.
        UnknownNameError: No such sight, choice of observations or of episodes.
        HandoverError: As `evaluate_pair` does.
    """
    run, how = describe(setup, options, execution, split=split, receiver=receiver, giver=giver)
    if keep not in KEEPS:
        raise UnknownNameError("keep", keep, KEEPS)
    check_observes(observe, sight)
    _check_run(run, how)
    check_hdf5()
    chosen_renderer(run.camera.renderer, run.physics, installed=sight is not None)
    with closing(DemonstrationShelf(Shown(sight, observe, keep == SUCCESS))) as shelf:
        evaluate_run(run, how, shelf)
        shelf.assemble()
    return Demonstrations(how.folder or "")


def _check_run(run: Run, how: Execution) -> None:
    check_setup_and_split(run.setup, run.split)
    if run.split != _TRAIN:
        purpose = "to choose with" if run.split == "val" else "for the last look"
        raise OptionError(
            f"demonstrations are for learning, and {run.setup} {run.split} is {purpose}: who learns from it has no "
            f"figures on it to tell. Take split {_TRAIN!r}"
        )
    if how.folder is None:
        raise OptionError("demonstrations need a folder: give one as out= (--out DIR)")
