"""Train the network of the receiver `gaddpg` by imitation. Needs the extras `train`, `plot`, `planning`, `vision`.

    python experiments/train_gaddpg.py --data-dir DIR --out runs/gaddpg

After Wang et al. (CoRL 2021): static objects without a hand, the planner `omg` as the expert, behaviour cloning with a
loss of goals, then rounds in which the network plays and the expert corrects it (DAgger). Nothing is simulated but
the last word: the validation split in fast physics, with the receiver as it is. The folder gets `policy.npz`, the best
network (`--receiver gaddpg:weights=runs/gaddpg/policy.npz --robot panda_camera`), a learning curve, TensorBoard logs,
plans, states and a checkpoint: `--resume` goes on where a run was stopped.
"""

import tyro

from handover_marl.imitation.gaddpg.gaddpg_training import GaddpgArgs, GaddpgTraining

if __name__ == "__main__":
    print(GaddpgTraining(tyro.cli(GaddpgArgs), "train_gaddpg").run())
