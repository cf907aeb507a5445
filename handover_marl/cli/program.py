"""Commands of the program `handover-marl`."""

from collections.abc import Callable, Sequence

import tyro

from handover_marl.cli import scenes
from handover_marl.cli.data_folders import run_doctor, run_import
from handover_marl.cli.folders import (
    run_compare,
    run_convert,
    run_evaluate,
    run_merge,
    run_strangers_references,
    run_strangers_table,
    run_verify,
)
from handover_marl.cli.runs import (
    run_agreement,
    run_benchmark,
    run_crossplay,
    run_demonstrate,
    run_pair,
    run_render,
    run_strangers,
)
from handover_marl.policies.registry import list_available

_DESCRIPTION = """Simulate and evaluate human-to-robot handovers.

Receivers: {receivers}.
Givers: {givers}.
A policy may also be your own class (my_package.robots:MyReceiver) and take options (omg:wait=1.5)."""

# In the order of the help text.
_COMMANDS: dict[str, Callable[..., int | None]] = {
    "benchmark": run_benchmark,
    "pair": run_pair,
    "agreement": run_agreement,
    "crossplay": run_crossplay,
    "strangers": run_strangers,
    "strangers-table": run_strangers_table,
    "strangers-references": run_strangers_references,
    "demonstrate": run_demonstrate,
    "convert": run_convert,
    "render": run_render,
    "evaluate": run_evaluate,
    "verify": run_verify,
    "compare": run_compare,
    "merge": run_merge,
    "import": run_import,
    "doctor": run_doctor,
}

_SCENE_COMMANDS: dict[str, Callable[..., None]] = {
    "add-object": scenes.add_object,
    "add-motion": scenes.add_motion,
    "add-split": scenes.add_split,
    "check": scenes.check,
    "preview": scenes.preview,
}


def run_program(arguments: Sequence[str]) -> int:
    """Run a command and return its exit status.

    Args:
        arguments: Command and options.

    Raises:
        HandoverError: The command failed.
    """
    names = {f"{agent}s": ", ".join(list_available(agent)) for agent in ("receiver", "giver")}
    app = tyro.extras.SubcommandApp()
    for name, run in _COMMANDS.items():
        app.command(name=name)(run)
    scenes_app = tyro.extras.SubcommandApp()
    for name, run in _SCENE_COMMANDS.items():
        scenes_app.command(name=name)(run)
    app.command(scenes_app, name="scenes", help="Build and check folders of custom scenes.")
    status: object = app.cli(
        prog="handover-marl",
        description=_DESCRIPTION.format(**names),
        args=arguments,
        config=(tyro.conf.OmitArgPrefixes,),
    )
    return status if isinstance(status, int) else 0
