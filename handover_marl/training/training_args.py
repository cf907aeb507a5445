"""The arguments that all training scripts have."""

from dataclasses import dataclass


@dataclass(frozen=True)
class LoopArgs:
    """What to train on, and how long.

    Attributes:
        out: Folder of the run.
        setup: Official setup, s0 to s3.
        data_dir: Folder in HandoverSim's layout; default: HANDOVER_MARL_DATA.
        dataset: dexycb, synthetic, or auto.
        physics: fast, exact, or mujoco, where environments are simulated in batches.
        control_period: How long an action stands (s).
        time_limit: Episodes in training are cut off after so long (s).
        seed: Of everything.
        steps: Decisions of an agent at most.
        minutes: Wall-clock time at most (min).
        envs: Environments.
        epochs: Passes over what was collected between updates.
        learning_rate: Of Adam.
        discount: Of rewards; guidance is made for it.
        trace: GAE's lambda.
        spread: Standard deviation of the outputs at first.
        val_scenes: Scenes of the validation split to evaluate on, evenly chosen.
    """

    out: str = "runs/training"
    setup: str = "s0"
    data_dir: str | None = None
    dataset: str = "auto"
    physics: str = "fast"
    control_period: float = 0.1
    time_limit: float = 13.0
    seed: int = 0
    steps: int = 500_000
    minutes: float = 60.0
    envs: int = 8
    epochs: int = 8
    learning_rate: float = 3e-4
    discount: float = 0.99
    trace: float = 0.95
    spread: float = 0.5
    val_scenes: int = 36


@dataclass(frozen=True)
class TrainingArgs(LoopArgs):
    """What to train on, and how long.

    Attributes:
        resume: Go on with the run in the folder.
    """

    resume: bool = False
