"""Receiver whose network controls the whole motion of the gripper, without a scripted approach."""

from pathlib import Path

from handover_marl.learning.adapters.function_policy import FunctionPolicy
from handover_marl.learning.policy_files import read_policy
from handover_marl.policies.policy import PolicyContext

_SHIPPED = Path(__file__).parent / "policies" / "dagger.npz"


class DaggerReceiver(FunctionPolicy):
    """Receiver whose network commands at every decision a motion of the gripper, and whether it opens or closes.

    The network was trained by DAgger (Ross, Gordon and Bagnell, AISTATS 2011) to imitate a policy whose approach to
    the grasp is scripted, see `experiments/training/train_receiver_dagger.py`.

    Args:
        context: Robot, task and known grasps of the objects.
        weights: Policy file; default: the one that ships.
    """

    name = "dagger"
    file_options = ("weights",)

    def __init__(self, context: PolicyContext, weights: str | None = None) -> None:
        path = _SHIPPED if weights is None else Path(weights).expanduser()
        spec, network, label = read_policy(path, "receiver")
        super().__init__(context, network, spec, self.name, self.name, digest=label)
