"""Commands of the program `handover-marl`."""

from collections.abc import Sequence

import tyro

from handover_marl.cli import folders, runs, scenes
from handover_marl.cli.options import OPTION_RULES
from handover_marl.policies.registry import list_available

_DESCRIPTION = """Simulate and evaluate human-to-robot handovers.

Receivers: {receivers}.
Givers: {givers}.
A policy may also be your own class (my_package.robots:MyReceiver) and take options (omg:wait=1.5)."""

# In the order of the help text; `run_strangers_table` is the command `strangers-table`.
_COMMANDS = (
    runs.run_benchmark,
    runs.run_evaluate_pair,
    runs.run_crossplay,
    runs.run_strangers,
    folders.run_strangers_table,
    runs.run_demonstrate,
    folders.run_convert,
    runs.run_render,
    folders.run_report,
    folders.run_verify,
    folders.run_compare,
    folders.run_import,
    folders.run_doctor,
)
_SCENE_COMMANDS = (scenes.add_object, scenes.add_motion, scenes.add_split, scenes.check, scenes.preview)


def run_program(arguments: Sequence[str]) -> int:
    """Run the command whose name and options are `arguments`; return the exit status."""
    names = {f"{agent}s": ", ".join(list_available(agent)) for agent in ("receiver", "giver")}
    app, scenes_app = tyro.extras.SubcommandApp(), tyro.extras.SubcommandApp()
    for group, commands in ((app, _COMMANDS), (scenes_app, _SCENE_COMMANDS)):
        for run in commands:
            group.command(name=run.__name__.removeprefix("run_").replace("_", "-"))(run)
    app.command(scenes_app, name="scenes", help="Build and check folders of custom scenes.")
    status: object = app.cli(
        prog="handover-marl",
        description=_DESCRIPTION.format(**names),
        args=arguments,
        config=(tyro.conf.OmitArgPrefixes,),
        registry=OPTION_RULES,
    )
    return status if isinstance(status, int) else 0
