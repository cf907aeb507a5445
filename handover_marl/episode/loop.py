"""Episode loop: policies act, the simulation advances, callbacks observe."""

import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

from handover_marl.config import PANDA_DOF, TIME_STEP
from handover_marl.datasets.dataset import Scene
from handover_marl.episode.episode import Episode
from handover_marl.episode.giver_motion import NO_DEVIATION
from handover_marl.episode.observations import Observation
from handover_marl.episode.spaces import STATE, check_giver_action, check_receiver_action, giver_action_space
from handover_marl.errors import OptionError, PolicyError, report_failure

Action = npt.NDArray[np.float32]
#: Inference time that is measured: the wall-clock time of each call of the receiver.
MEASURED: Final = "measured"
#: Simulated time (s) that passes during each call of the receiver, or `MEASURED`; None: no simulated time passes.
InferenceTime: TypeAlias = float | Literal["measured"] | None

_LONGEST_HOLD = 1e9  # s


@dataclass(frozen=True, eq=False)
class PolicyDecision:
    """Actions of both policies for the next physics steps.

    Attributes:
        receiver_action: (9,) target joint positions in effect from now on, 7 arm (rad) and 2 fingers (m).
        giver_action: (8,) action of the giver, see `giver_action_space`.
        planning_time: Wall-clock time of the receiver's policy (s), without rendering; 0 if it was not called now.
        receiver_action_changed: Whether a new action of the receiver takes effect now; otherwise its last one is held.
        giver_decided: Whether the giver's policy acted now; always false if the giver has no policy.
    """

    receiver_action: npt.NDArray[np.float32]
    giver_action: npt.NDArray[np.float32]
    planning_time: float
    receiver_action_changed: bool
    giver_decided: bool


class EpisodeCallback:
    """Base class of callbacks of the episode loop; subclasses override the hooks that they need.

    Callbacks read the episode and do not change it.
    """

    def on_reset(self, episode: Episode) -> None:
        """Handle the start of an episode; the base class does nothing."""

    def on_decision(self, episode: Episode, decision: PolicyDecision) -> None:
        """Handle the actions for the next steps, whenever a policy has decided or a delayed action takes effect."""

    def on_step(self, episode: Episode) -> None:
        """Handle a physics step, after the referee has updated the episode's status."""

    def on_end(self, episode: Episode) -> None:
        """Handle the end of the episode loop."""


class ActionRecorder(EpisodeCallback):
    """Recorder of the receiver's action and planning time in every physics step, for HandoverSim's result files.

    Attributes:
        actions: (T, 9) float32 actions; set at the end of an episode.
        times: (T,) planning times (s), zero in steps without a decision; set at the end of an episode.
    """

    actions: npt.NDArray[np.float32]
    times: npt.NDArray[np.float64]

    def __init__(self) -> None:
        self._decisions: list[tuple[int, PolicyDecision]] = []

    def on_reset(self, episode: Episode) -> None:
        """Discard the records of the last episode."""
        self._decisions = []

    def on_decision(self, episode: Episode, decision: PolicyDecision) -> None:
        """Record the receiver's action and planning time, and the physics step of the decision."""
        self._decisions.append((episode.steps, decision))

    def on_end(self, episode: Episode) -> None:
        """Set `actions` and `times` of the episode; held actions are repeated in every step."""
        self.actions = np.zeros((episode.steps, PANDA_DOF), dtype=np.float32)
        self.times = np.zeros(episode.steps)
        ends = [step for step, _ in self._decisions[1:]] + [episode.steps]
        for (step, decision), end in zip(self._decisions, ends, strict=True):
            self.actions[step:end] = decision.receiver_action
            self.times[step] = decision.planning_time


class EpisodePolicy(Protocol):
    """Interface of a policy in the episode loop; see `handover_marl.policies.policy.Policy`."""

    @property
    def name(self) -> str:
        """Name of the policy."""

    def prepare(self, object_names: Sequence[str]) -> None:
        """Prepare for episodes with the objects of these class names."""

    def reset(self, seed: int | None = None) -> None:
        """Start an episode; `seed` seeds the policy's random generator."""

    def act(self, observation: Observation) -> Action:
        """Return the agent's action for an observation."""

    @property
    def hold_time(self) -> float:
        """Time (s) for which the last action is held before the policy is called again."""


def start_policy(policy: EpisodePolicy, seed: int | None, object_names: Sequence[str] = ()) -> None:
    """Prepare a policy for an episode and reset it; errors of the policy's code become `PolicyError`.

    Args:
        policy: Policy to start.
        seed: Seed of the policy.
        object_names: Class names of the objects; the first object is handed over.
    """
    with report_failure(PolicyError, f"policy {policy.name!r} (reset)"):
        policy.prepare(object_names)
        policy.reset(seed)


def call_policy(policy: EpisodePolicy, observation: Observation, step: int) -> tuple[Action, int]:
    """Return a policy's action and the physics step of its next call; errors of the policy become `PolicyError`.

    Args:
        policy: Policy to call.
        observation: Observation of the policy's agent.
        step: Number of physics steps since the start of the episode.
    """
    with report_failure(PolicyError, f"policy {policy.name!r} (after {step} steps)", observation):
        action, hold_time = policy.act(observation), policy.hold_time
    return action, step + steps_from_hold_time(hold_time)


def steps_from_hold_time(hold_time: float) -> int:
    """Convert a hold time (s) to physics steps of 1 ms, from 1 to 10^12; raise `OptionError` if it is not positive."""
    if isinstance(hold_time, (bool, str)) or not isinstance(hold_time, (int, float, np.number)) or not hold_time > 0:
        raise OptionError(f"hold_time must be a positive number (s), got {hold_time!r}")
    return max(1, round(min(hold_time, _LONGEST_HOLD) / TIME_STEP))


class EpisodeAgent:
    """Agent in one episode: calls a policy at the policy's own control period, and holds its action in between.

    The policy's seed is derived from the run seed, by `derive_giver_seed` or `derive_receiver_seed`. The policy of a
    receiver is reset at its first decision.

    Args:
        episode: Episode at the start of a scene.
        agent: Agent that the policy acts for, "giver" or "receiver".
        policy: Policy; the observation of a receiver is empty if its attribute `obs_mode` is None.
        seed: Seed of the run.
        inference_time: Simulated time of a call of the policy (s), or `MEASURED`. Until it has passed, the previous
            action stays in effect (before the first one, the robot holds its joint positions), and no call is made.
            None: actions take effect at once.

    Attributes:
        agent: Agent that the policy acts for.
        action: Action in effect; an empty array before the first decision.
        pending_action: Action that was decided and is not in effect yet, or None.
        next_decision_step: Physics step of the policy's next call.
        planning_time: Wall-clock time of the last call of the policy (s), without rendering.
    """

    def __init__(
        self,
        episode: Episode,
        agent: str,
        policy: EpisodePolicy,
        seed: int | None,
        inference_time: InferenceTime = None,
    ) -> None:
        self.agent, self.action = agent, np.zeros(0, dtype=np.float32)
        self.next_decision_step, self.planning_time = 0, 0.0
        self.pending_action: Action | None = None
        self._effect_step, self._inference_time = 0, inference_time
        self._episode, self._policy, self._seed = episode, policy, seed
        self._is_giver = agent == "giver"
        self._giver_space, self._objects = giver_action_space(episode.config.giver), episode.scene.info.object_names
        if self._is_giver:
            start_policy(policy, derive_giver_seed(seed, episode.scene.info.scene_id), self._objects)

    @property
    def observes(self) -> bool:
        """Whether the policy gets an observation, rather than an empty dictionary."""
        return self._is_giver or getattr(self._policy, "obs_mode", STATE) is not None

    @property
    def next_event(self) -> int:
        """Physics step in which the pending action takes effect; without one, that of the policy's next call."""
        return self.next_decision_step if self.pending_action is None else self._effect_step

    def update(self) -> None:
        """Put the pending action, if there is one, into effect if its inference time has passed."""
        if self.pending_action is not None and self._episode.steps >= self._effect_step:
            self.action, self.pending_action = self.pending_action, None

    def act(self) -> Action:
        """Return the action for this physics step: call the policy if that is due, else return the held action."""
        if self._episode.steps >= self.next_decision_step:
            self.decide(self._episode.observe() if self.observes else {})
        return self.action

    def decide(self, state: Observation) -> None:
        """Call the policy; its action is pending during the inference time, then in effect until the next one is.

        `state` is the full state as `Episode.observe` returns it now; {} if the policy does not observe.
        """
        episode = self._episode
        if self._is_giver:
            # Copies, so that a policy that writes into its arrays does not change the other's.
            observation = {key: value.copy() for key, value in episode.observe_giver(state).items()}
        else:
            observation = episode.observe_for_policy(self._policy, state) if self.observes else {}
        if not self._is_giver and not self.action.size:
            start_policy(self._policy, derive_receiver_seed(self._seed, observation), self._objects)
        started = time.perf_counter()
        action, self.next_decision_step = call_policy(self._policy, observation, episode.steps)
        self.planning_time = time.perf_counter() - started
        found = check_giver_action(action, self._giver_space) if self._is_giver else check_receiver_action(action)
        if self._inference_time is None:
            self.action = found
            return
        if not self.action.size:
            self.action = episode.world.read_joint_snapshot().robot.copy()
        passed = self.planning_time if self._inference_time == MEASURED else float(self._inference_time)
        self.pending_action, self._effect_step = found, episode.steps + round(passed / TIME_STEP)
        self.next_decision_step = max(self.next_decision_step, self._effect_step)
        self.update()


def run_episode(
    episode: Episode,
    receiver: EpisodePolicy,
    giver: EpisodePolicy | None = None,
    *,
    seed: int | None = None,
    until: int | Callable[[], bool] | None = None,
    callbacks: Sequence[EpisodeCallback] = (),
    inference_time: InferenceTime = None,
) -> int:
    """Run one episode in which policies act, from its start until it ends or `until` stops it.

    Args:
        episode: Episode at the start of a scene, after `Episode.reset`.
        receiver: Policy of the robot; its observation is empty if its attribute `obs_mode` is None.
        giver: Policy of the person; None replays the recording.
        seed: Seed of the run, from which the seeds of policies and camera are derived.
        until: Largest number of physics steps, or a function that returns True to end the loop, which calls it after
            each decision, before the actions are applied.
        callbacks: Callbacks, called in this order.
        inference_time: Simulated time that passes during each call of the receiver, see `EpisodeAgent`.

    Returns:
        Number of physics steps that passed while a decided action of the receiver was not in effect yet.
    """
    horizon = episode.config.protocol.horizon_steps
    end = horizon if until is None or callable(until) else min(int(until), horizon)
    episode.seed_camera(derive_seed(seed, "camera"))
    robot = EpisodeAgent(episode, "receiver", receiver, seed, inference_time)
    person = None if giver is None else EpisodeAgent(episode, "giver", giver, seed)
    # The giver acts first.
    agents = [robot] if person is None else [person, robot]
    step_hooks = [callback.on_step for callback in callbacks]
    n_late = 0
    for callback in callbacks:
        callback.on_reset(episode)
    while not episode.status and episode.steps < end:
        held = robot.action
        robot.update()
        deciding = [agent for agent in agents if episode.steps >= agent.next_decision_step]
        state = episode.observe() if any(agent.observes for agent in deciding) else {}
        for agent in deciding:
            agent.decide(state)
        decision = PolicyDecision(
            receiver_action=robot.action,
            giver_action=NO_DEVIATION if person is None else person.action,
            planning_time=robot.planning_time if robot in deciding else 0.0,
            receiver_action_changed=robot.action is not held,
            giver_decided=person in deciding,
        )
        if callable(until) and until():
            break
        for callback in callbacks:
            callback.on_decision(episode, decision)
        start, event = episode.steps, min(end, *(agent.next_event for agent in agents))
        episode.advance(decision.receiver_action, event - start, decision.giver_action, step_hooks)
        n_late += 0 if robot.pending_action is None else episode.steps - start
    for callback in callbacks:
        callback.on_end(episode)
    return n_late


def derive_giver_seed(seed: int | None, scene_id: int) -> int:
    """Derive the seed of a giver: a hash of the run's seed (None is 0) and the scene number.

    Only the giver may use this seed. If a receiver observed random draws with this seed, such as camera noise, it could
    find the scene number by trying all numbers.
    """
    return derive_seed(seed, f"{scene_id} giver")


def derive_robot_seed(seed: int | None, scene: Scene) -> int:
    """Derive the seed of the robot's initial joint positions: a hash of the run's seed and the objects' first poses.

    A receiver observes these joint positions and must not learn the scene number from them. So the seed depends on
    values that are observed anyway. A run seed of None is 0.
    """
    return derive_seed(seed, "robot", scene.object_dof[0])


def derive_receiver_seed(seed: int | None, observation: Observation) -> int:
    """Derive the seed of a receiver: a hash of the run's seed (None is 0) and the receiver's first observation.

    Scenes with different first observations give different seeds; the scene number is not used.
    """
    others = observation.get("wrist_other_points")
    if others is not None and not others.any():
        # Without other objects in the image, the seed is that of the observation mode "pointcloud".
        observation = {**observation, "wrist_point_counts": observation["wrist_point_counts"][:2]}
        del observation["wrist_other_points"]
    return derive_seed(seed, "receiver", *(part for key in sorted(observation) for part in (key, observation[key])))


def derive_seed(seed: int | None, user: str, *observed: str | npt.NDArray[Any]) -> int:
    """Return a seed of 32 bits: a hash of the run's seed (None is 0), text that names its use, and observed data."""
    digest = hashlib.sha256(f"handover_marl {seed or 0} {user}".encode())
    for part in observed:
        digest.update(part.encode() if isinstance(part, str) else part.tobytes())
    return int.from_bytes(digest.digest()[:4], "big")
