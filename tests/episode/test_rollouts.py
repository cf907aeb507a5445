"""Tests of the simulation of many worlds at once; each has the steps, release and end of a world simulated alone."""

from collections.abc import Sequence

import numpy as np
import pytest

from handover_marl.config import ProtocolConfig
from handover_marl.episode.referee import EpisodeStatus, Referee, RefereeState, ReleaseReason, make_judge
from handover_marl.simulation.world import NO_POINTS, ContactBatch, Contacts
from tests.episode.test_lockstep import stack_contacts

pytest.importorskip("mujoco")

from handover_marl.simulation.mujoco.world import MujocoWorld, TruncateFunction

RULES = ProtocolConfig(release_steps=40, success_steps=30, horizon_steps=400)
INSIDE = np.array([[0.0, 0.0, 0.03]], dtype=np.float32)
HOLD = Contacts(robot_touches_object=True, finger_points=(INSIDE, INSIDE), object_height=1.2)
PUSH = Contacts(robot_touches_object=True, object_height=1.2)
ONE_FINGER = Contacts(robot_touches_object=True, finger_points=(INSIDE, NO_POINTS), object_height=1.2)
APART = Contacts(object_height=1.2)
AT_GOAL = HOLD._replace(gripper_position=RULES.goal_center)
#: Contacts of some steps, and the number of those steps.
KINDS = {
    "hold": (HOLD, 25),
    "goal": (AT_GOAL, 25),
    "push": (PUSH, 25),
    "one finger": (ONE_FINGER, 10),
    "apart": (APART, 10),
    "far push": (PUSH._replace(gripper_position=(0.0, 0.0, 0.0)), 25),
    # Just inside and outside of the goal's ball, along its diagonal.
    "in the ball": (HOLD._replace(gripper_position=tuple(value + 0.085 for value in RULES.goal_center)), 35),
    "out of the ball": (HOLD._replace(gripper_position=tuple(value - 0.088 for value in RULES.goal_center)), 35),
    "far apart": (APART, 130),
    "low": (APART._replace(object_height=0.5), 1),
    "supported": (ONE_FINGER._replace(object_supported=True), 1),
    "contact": (APART._replace(robot_touches_hand=True), 1),
    "low contact": (APART._replace(robot_touches_hand=True, object_height=0.5), 1),
    "contact at the goal": (AT_GOAL._replace(robot_touches_hand=True), 1),
}
N_STEPS = 300


class ScriptedWorld:
    """Stub of a world that has given contacts and checks the calls of its methods."""

    rollout = classmethod(MujocoWorld.rollout.__func__)  # type: ignore[attr-defined]
    sizes: list[int]
    lengths: list[int]

    def __init__(self, steps: list[Contacts], number: int, key: object, max_steps: int, is_asleep: bool) -> None:
        self.steps, self.target = steps, [float(number)] * 9
        self.rollout_key = key
        self.remaining_steps, self.is_asleep = max_steps, is_asleep
        self.position, self.is_prepared = 0, False
        self.releases: list[int] = []

    def release_target(self) -> None:
        self.releases.append(self.position)

    @classmethod
    def prepare(cls, worlds: Sequence["ScriptedWorld"], robot_targets: Sequence[list[float]]) -> None:
        assert [world.target for world in worlds] == robot_targets
        assert len(worlds) <= 32
        for world in worlds:
            assert world.is_asleep
            assert not world.is_prepared
            world.is_prepared = True

    @classmethod
    def simulate(
        cls, worlds: Sequence["ScriptedWorld"], robot_targets: Sequence[list[float]], steps: int, rules: ProtocolConfig
    ) -> tuple[ContactBatch, TruncateFunction]:
        assert [world.target for world in worlds] == robot_targets
        assert len({world.rollout_key for world in worlds}) == 1
        assert 0 < steps <= min(world.remaining_steps for world in worlds)
        assert all(world.position + steps <= N_STEPS for world in worlds), "more steps than the reference motion has"
        cls.sizes.append(len(worlds))
        cls.lengths.append(steps)
        columns = [stack_contacts(world.steps[world.position : world.position + steps], rules) for world in worlds]
        for world in worlds:
            assert world.is_prepared is world.is_asleep
            world.position += steps
            world.is_prepared = False

        def truncate(number: int, done: int) -> None:
            assert 0 < done < steps
            worlds[number].position += done - steps

        contacts = ContactBatch(*(np.concatenate(column, axis=1) for column in zip(*columns, strict=True)))
        return contacts, truncate


def draw_steps(rng: np.random.Generator) -> list[Contacts]:
    steps: list[Contacts] = []
    while len(steps) < N_STEPS:
        kinds = [*(["hold", "goal", "push", "far push", "in the ball"] * 4), *KINDS]
        contacts, count = KINDS[kinds[rng.integers(len(kinds))]]
        steps += [contacts] * count
    return steps[:N_STEPS]


def stack_states(states: list[RefereeState]) -> RefereeState:
    return RefereeState(*np.array(states).T.copy())


def draw_state(rng: np.random.Generator) -> RefereeState:
    """Return the state of an episode that has run for some steps, released or not."""
    referee = Referee(RULES)
    start = referee.get_state()._replace(steps=int(rng.integers(1, 380)))
    reason = int(rng.integers(-1, len(ReleaseReason)))
    return start if reason < 0 else start._replace(release_reason=reason, release_step=1)


def test_worlds_are_simulated_as_if_alone() -> None:
    rng = np.random.default_rng(0)
    ScriptedWorld.sizes, ScriptedWorld.lengths = [], []
    keys = ["large"] * 40 + ["small"] * 5 + ["asleep"] * 35
    worlds = [
        ScriptedWorld(draw_steps(rng), number, key, 1000 if key == "large" else 37, key == "asleep")
        for number, key in enumerate(keys)
    ]
    states = [draw_state(rng) for _ in worlds]
    referees = stack_states(states)
    targets = [world.target for world in worlds]
    simulated = ScriptedWorld.rollout(worlds, targets, N_STEPS, make_judge(referees, RULES), RULES)
    statuses, reasons = set(), set()
    for number, (world, state) in enumerate(zip(worlds, states, strict=True)):
        alone = Referee(RULES)
        alone.restore(state)
        count, releases = 0, []
        while count < N_STEPS and not alone.status:
            was_released = alone.released
            alone.update(world.steps[count])
            count += 1
            if alone.released and not was_released:
                releases.append(count)
        assert (simulated[number], world.position, world.releases) == (count, count, releases)
        found, expected = referees.select_rows(number), alone.get_state()
        # The goal count of an episode that is over has no use.
        assert found._replace(goal_steps=0) == expected._replace(goal_steps=0)
        if not alone.status:
            assert found.goal_steps == expected.goal_steps
        statuses.add(alone.status)
        reasons.add(alone.release_reason)
    assert statuses >= {EpisodeStatus(status) for status in (1, 2, 4, 6, 8)}
    assert reasons == {None, *ReleaseReason}
    assert (max(ScriptedWorld.sizes), max(ScriptedWorld.lengths)) == (32, 100)
