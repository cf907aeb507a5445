"""Columns of tables. A column has one key, in JSON and CSV; its title in tables follows from the key."""

from dataclasses import dataclass

from handover_marl.episode.referee import EpisodeStatus


@dataclass(frozen=True)
class Column:
    """Column of tables with a number in every row.

    Attributes:
        key: Key in JSON and CSV.
        unit: Unit in tables.
        scale: Factor from the unit in JSON and CSV to the unit in tables.
    """

    key: str
    unit: str = ""
    scale: float = 1.0

    @property
    def title(self) -> str:
        """Title in tables: the key's words and the unit."""
        words = self.key.replace("_", " ")
        return words if not self.unit or words.endswith(f" {self.unit}") else f"{words} {self.unit}"


#: Statuses whose rates are reported.
REPORTED_STATUSES = (
    EpisodeStatus.SUCCESS,
    EpisodeStatus.HUMAN_CONTACT,
    EpisodeStatus.OBJECT_DROP,
    EpisodeStatus.TIMEOUT,
)
N_EPISODES = Column("n_episodes")
#: Rates of the reported statuses, and the numbers of episodes with them.
RATES = tuple(Column(status.label, "%", 100.0) for status in REPORTED_STATUSES)
COUNTS = tuple(Column(f"n_{status.label}") for status in REPORTED_STATUSES)
AVERAGE_SUCCESS, WAIT = Column("AS", "%", 100.0), Column("wait_s", "s")
#: Means over successes: simulated time, wall-clock time of the policy, and their sum.
TIMES = (Column("exec_s", "s"), Column("plan_s", "s"), Column("total_s", "s"))
#: The metrics of `FluencyMetrics`, in its order.
FLUENCY = (
    Column("handover_time", "s"),
    Column("human_idle", "%", 100.0),
    Column("robot_idle", "%", 100.0),
    Column("concurrent", "%", 100.0),
    Column("functional_delay", "%", 100.0),
    Column("max_robot_object_force", "N"),
    Column("min_distance", "cm", 100.0),
    Column("giver_path", "m"),
    Column("giver_smoothness", "SPARC"),
    Column("reach", "m"),
    Column("max_robot_hand_force", "N"),
    Column("robot_hand_impulse", "N s"),
    Column("giver_jerk", "m/s^3"),
    Column("gripper_jerk", "m/s^3"),
    Column("gripper_path", "m"),
    Column("gripper_max_speed", "m/s"),
    Column("gripper_mean_speed", "m/s"),
    Column("exchange_time", "s"),
    Column("gripper_contact_speed", "m/s"),
    Column("robot_object_impulse", "N s"),
    Column("min_separation_margin", "cm", 100.0),
    Column("giver_rula"),
)
