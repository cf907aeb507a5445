"""The one loop that asks policies and advances the world."""

import hashlib
import time
from collections.abc import Callable, Sequence

from handover_marl.episode.clock import Player, PolicyClock
from handover_marl.episode.episode import Episode
from handover_marl.episode.playback import NO_DEVIATION
from handover_marl.episode.spaces import check_giver_action, check_receiver_action, giver_action_space
from handover_marl.episode.watchers import Decision, Watcher


def play(
    episode: Episode,
    receiver: Player,
    giver: Player | None = None,
    *,
    seed: int | None = None,
    until: int | Callable[[], bool] | None = None,
    watchers: Sequence[Watcher] = (),
) -> None:
    """Let policies act from the start of a scene until the episode ends.

    Args:
        episode: At the start of a scene (`Episode.reset`).
        receiver: The robot's policy; asked when it wants to be.
        giver: The person's, likewise; None replays the recording.
        seed: For what the policies draw; each gets one of its own, made from this one and the scene by a hash.
        until: Stop already after so many physics steps, or once this says so; it is asked after every decision.
        watchers: Who looks on.

    Raises:
        ActionError: A policy's action is malformed.
        PolicyError, OptionError: A policy fails, or wants its action held for no time.
    """
    horizon = episode.config.protocol.horizon_steps
    end = min(until, horizon) if isinstance(until, int) else horizon
    robot_clock = PolicyClock(receiver)
    giver_clock = None if giver is None else PolicyClock(giver)
    scene_id, objects = episode.scene.info.scene_id, episode.scene.info.object_names
    robot_clock.reset(policy_seed(seed, scene_id, "receiver"), objects)
    episode.seed_sight(policy_seed(seed, scene_id, "camera"))
    if giver_clock is not None:
        giver_clock.reset(policy_seed(seed, scene_id, "giver"), objects)
    giver_space = giver_action_space(episode.config.giver)
    deviation = NO_DEVIATION
    for watcher in watchers:
        watcher.started(episode)
    while not episode.status and episode.steps < end:
        now, seconds, drawing = episode.steps, 0.0, 0.0
        observation = episode.observe()
        giver_asked = giver_clock is not None and now >= giver_clock.due
        robot_asked = now >= robot_clock.due
        if giver_clock is not None and giver_asked:
            seen = episode.observe_as_giver(observation)
            # Copies, so that what a policy does to its arrays stays unseen by the other.
            seen = {key: value.copy() for key, value in seen.items()}
            deviation = check_giver_action(giver_clock.ask(seen, now), giver_space)
        if robot_asked:
            # Drawing what it sees is not planning.
            looked = time.perf_counter()
            seen = episode.observe_for(receiver, observation)
            started = time.perf_counter()
            drawing = started - looked
            action = robot_clock.ask(seen, now)
            seconds = time.perf_counter() - started
            robot = check_receiver_action(action)
        if callable(until) and until():
            break
        for watcher in watchers:
            watcher.decided(episode, Decision(robot, deviation, seconds, robot_asked, giver_asked, drawing))
        due = min(clock.due for clock in (robot_clock, giver_clock) if clock is not None)
        episode.advance(robot, min(end, due) - now, deviation, [watcher.stepped for watcher in watchers])
    for watcher in watchers:
        watcher.ended(episode)


def policy_seed(seed: int | None, scene_id: int, agent: str) -> int:
    """The seed of one policy in one scene; it cannot be told from it which scene that is."""
    digest = hashlib.sha256(f"handover_marl {seed or 0} {scene_id} {agent}".encode()).digest()
    return int.from_bytes(digest[:4], "big")
