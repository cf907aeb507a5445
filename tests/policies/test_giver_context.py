"""Tests of the context of givers: it equals that of receivers, and givers need no constructor for it."""

import pytest

from handover_marl.config import WorldConfig
from handover_marl.datasets.synthetic import SyntheticDataset
from handover_marl.episode.observations import Observation
from handover_marl.errors import OptionError
from handover_marl.givers import Action, Giver, PolicyContext, make_giver_action, make_policy_context
from handover_marl.policies.policy import Policy
from handover_marl.policies.reference import PolicyLike, parse_policy

DATA = SyntheticDataset()


class Plain(Giver):
    name = "plain"

    def reset(self, seed: int | None = None) -> None:
        self.seed = seed

    def act(self, observation: Observation) -> Action:
        return make_giver_action()


class Lifting(Plain):
    """Giver whose constructor takes the context and an option, as constructors of receivers do."""

    name = "lifting"

    def __init__(self, context: PolicyContext, height: float = 0.1) -> None:
        super().__init__(context)
        self.height = height


class Alone(Plain):
    """Giver whose constructor takes no context."""

    name = "alone"

    def __init__(self, height: float = 0.1) -> None:
        self.height = height


class Keeping(Plain):
    """Giver whose constructor sets the attribute `context`."""

    name = "keeping"

    def __init__(self, context: PolicyContext) -> None:
        self.context = context


def make(policy: PolicyLike, setup: str = "s0") -> Policy:
    return parse_policy("giver", policy).make(DATA, WorldConfig(), setup)


@pytest.mark.parametrize("policy", [Plain, Lifting, (Lifting, {"height": 0.2}), Keeping, "replay", "cooperative"])
def test_classes_and_names_get_the_context(policy: PolicyLike) -> None:
    made = make(policy, "s2")
    assert isinstance(made, Giver)
    assert made.context.setup == "s2"
    assert made.context.object_urdf("025_mug").is_file()


def test_givers_work_without_a_context() -> None:
    for made in (make(Alone), make(Plain()), Plain()):
        made.reset()
        assert isinstance(made, Giver)
        with pytest.raises(OptionError, match=r"context must be given to the constructor of (Alone|Plain), got none"):
            _ = made.context
    context = make_policy_context(DATA)
    assert Plain(context).context is context
