"""Published results of receivers, shown beside evaluations for comparison.

Rows of HandoverSim (Chao et al., ICRA 2022) are from Table II of the paper. The row of handover-sim2real (Christen et
al., CVPR 2023) is what the authors' repository reports of its model; the paper reports a mean over training seeds. The
robot's wait before the approach differs between methods and is always stated: after a short wait, the hand still moves.
"""

from dataclasses import dataclass

from handover_marl.config import OFFICIAL_CONFIG, TIME_STEP
from handover_marl.evaluation.config import REPLAY
from handover_marl.evaluation.metadata import OFFICIAL_WORLD, ResultMetadata


@dataclass(frozen=True)
class PublishedResult:
    """Published result of one method: rates (%), and times (s) on the authors' machine.

    Times are means: simulated time to success (`time_exec`), wall-clock time in the policy (`time_plan`), and their
    sum. `wait_s` is the time that the robot waits before it approaches (s), and `source` a key of `SOURCES`.
    """

    method: str
    wait_s: float
    success: float
    time_exec: float
    time_plan: float
    time_total: float
    contact: float
    drop: float
    timeout: float
    source: str = "HandoverSim"

    @property
    def average_success(self) -> float:
        """Average success (AS) in percent, computed from mean time to success and success rate."""
        return self.success * (1.0 - self.time_exec / (OFFICIAL_CONFIG.protocol.horizon_steps * TIME_STEP))


#: References of the published rows.
SOURCES = {
    "HandoverSim": "Chao et al., ICRA 2022, Table II",
    "handover-sim2real": "handover-sim2real (Christen et al., CVPR 2023), one model, as its repository reports it",
}

#: Results on the test split of each setup, DexYCB with all objects.
PUBLISHED = {
    "s0": (
        PublishedResult("OMG Planner", 3.0, 62.50, 8.309, 1.414, 9.722, 27.78, 8.33, 1.39),
        PublishedResult("Yang et al.", 3.0, 64.58, 4.864, 0.036, 4.900, 17.36, 11.81, 6.25),
        PublishedResult("GA-DDPG hold", 3.0, 50.00, 7.139, 0.142, 7.281, 4.86, 19.44, 25.69),
        PublishedResult("GA-DDPG w/o hold", 0.0, 36.81, 4.664, 0.132, 4.796, 9.03, 25.00, 29.17),
        PublishedResult("handover-sim2real", 1.5, 68.06, 6.206, 0.175, 6.380, 10.42, 15.97, 5.56, "handover-sim2real"),
    ),
    "s1": (
        PublishedResult("OMG Planner", 3.0, 62.78, 8.012, 1.355, 9.366, 33.33, 2.22, 1.67),
        PublishedResult("Yang et al.", 3.0, 62.78, 4.719, 0.039, 4.758, 14.44, 7.78, 15.00),
        PublishedResult("GA-DDPG hold", 3.0, 55.00, 6.791, 0.136, 6.927, 8.89, 15.00, 21.11),
        PublishedResult("GA-DDPG w/o hold", 0.0, 33.33, 4.261, 0.132, 4.393, 15.56, 21.67, 29.44),
    ),
    "s2": (
        PublishedResult("OMG Planner", 3.0, 62.78, 8.275, 1.481, 9.755, 30.56, 3.89, 2.78),
        PublishedResult("Yang et al.", 3.0, 62.50, 4.808, 0.034, 4.843, 16.11, 10.56, 10.83),
        PublishedResult("GA-DDPG hold", 3.0, 55.00, 7.145, 0.129, 7.274, 8.61, 17.78, 18.61),
        PublishedResult("GA-DDPG w/o hold", 0.0, 28.33, 4.747, 0.133, 4.881, 9.17, 34.44, 28.06),
    ),
    "s3": (
        PublishedResult("OMG Planner", 3.0, 69.00, 8.478, 1.588, 10.066, 23.00, 4.00, 4.00),
        PublishedResult("Yang et al.", 3.0, 62.00, 4.805, 0.031, 4.837, 18.00, 9.00, 11.00),
        PublishedResult("GA-DDPG hold", 3.0, 50.00, 7.305, 0.135, 7.440, 5.00, 23.00, 22.00),
        PublishedResult("GA-DDPG w/o hold", 0.0, 33.00, 4.948, 0.123, 5.071, 10.00, 33.00, 24.00),
    ),
}


def find_published_results(metadata: ResultMetadata) -> tuple[PublishedResult, ...]:
    """Return published results comparable with an evaluation: of the same setup, split, data, giver, physics, rules."""
    identity = (metadata.split, metadata.dataset, metadata.giver, metadata.physics, metadata.world)
    is_official = identity == ("test", "dexycb", REPLAY, "exact", OFFICIAL_WORLD) and not metadata.inference_time
    return PUBLISHED.get(metadata.setup, ()) if is_official else ()
