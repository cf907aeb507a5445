"""Write the page with a card for each giver of a population: options, events, noise floor and image grids.

    python experiments/strangers/make_cards.py --out docs/reference/strangers_v1.md

Events are read from the table of the selection of the population, outcomes from the file of `measure_controls.py`.
Run the script again after a change of the population, of the selection or of the controls.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from docstring_parser import parse
from measure_controls import count_changes, format_controls, format_noise_floor

from handover_marl.evaluation.reports.tables import NO_VALUE, format_percent_rate, format_table
from handover_marl.execution.files import write_atomically
from handover_marl.policies.policy import get_parameters
from handover_marl.policies.populations import DEFAULT_POPULATION, Partner, Population, load_population
from handover_marl.policies.reference import parse_policy

# Parameters of constructors that are no options.
_NO_OPTIONS = ("context", "agent", "path", "trust")
# First columns of the table of the selection, before the events.
_KEYS = ("giver", "family", "selected")


@dataclass(frozen=True, kw_only=True)
class Args:
    """Options of the page of cards.

    Attributes:
        out: Page to write. The image grids are in the folder beside it that has its name.
        population: Name of a shipped population, or path of a file.
        events: Page with the table of events of the candidates.
        controls: File of `measure_controls.py`.
    """

    out: Path
    population: str = DEFAULT_POPULATION
    events: Path = Path("docs/results/population.md")
    controls: Path = Path("docs/results/data/strangers_controls.json")


def read_events(page: Path) -> dict[str, dict[str, str]]:
    """Read the mean events of every candidate from the table in a page, by name of the candidate."""
    rows = [line.strip().strip("|").split("|") for line in page.read_text().splitlines() if line.startswith("| ")]
    table = [[cell.strip().strip("`") for cell in row] for row in rows]
    start = next(number for number, row in enumerate(table) if tuple(row[:3]) == _KEYS)
    header, found = table[start], {}
    for row in table[start + 1 :]:
        if len(row) == len(header):
            found[row[0]] = dict(zip(header[len(_KEYS) :], row[len(_KEYS) :], strict=True))
    return found


def list_options(population: Population, giver: Partner) -> list[tuple[str, str, str]]:
    """Return name, value and meaning of every option of a giver, with the bounds that its documentation states."""
    reference = parse_policy("giver", population.get_policy(giver))
    policy_class = reference.policy_class
    meanings = {part.arg_name: part.description or "" for part in parse(policy_class.__doc__ or "").params}
    given = dict(reference.options)
    return [
        (
            f"`{name}`",
            f"{given[name]:g}" if name in given else f"{parameter.default} (default)",
            " ".join(meanings.get(name, "").split()),
        )
        for name, parameter in get_parameters(policy_class).items()
        if name not in _NO_OPTIONS and (name in given or parameter.default is not None)
    ]


def format_card(population: Population, giver: Partner, events: Mapping[str, str], noise_floor: str) -> str:
    """Return the card of a giver: description, policy, options, events and noise floor."""
    parts = [f"### {giver.name}", f"{giver.description} Family {giver.family}, split {giver.split}."]
    parts.append(f"Policy: `{giver.policy}`")
    if options := list_options(population, giver):
        parts.append(format_table(["option", "value", "meaning and bounds"], options, max_width=1000))
    rows = [*events.items(), ("outcomes changed by a perturbation, %", noise_floor)]
    parts.append(format_table([title for title, _ in rows], [[value for _, value in rows]], max_width=1000))
    return "\n\n".join(parts)


def format_receivers(receivers: Sequence[Partner]) -> str:
    """Return the table of the receivers, the partners of givers."""
    rows = [(each.name, each.family, each.split, f"`{each.policy}`", each.description) for each in receivers]
    return format_table(["receiver", "family", "split", "policy", "behaviour"], rows, max_width=1000)


def format_page(
    population: Population, events: Mapping[str, Mapping[str, str]], controls: Mapping[str, Any], images: Path
) -> str:
    """Return the page.

    Args:
        population: Population.
        events: Mean events by name of the giver.
        controls: Content of the file of `measure_controls.py`.
        images: Folder with an image grid FAMILY.jpg for each family; its parent is the folder of the page.
    """
    entries = controls["givers"]
    sections = [_INTRODUCTION.format(population=population)]
    for family in dict.fromkeys(giver.family for giver in population.givers):
        sections.append(f"## Family {family}")
        if (images / f"{family}.jpg").is_file():
            alternative = f"Episodes of the family {family} in one scene: a row for each giver, a column for each time"
            sections.append(f"![{alternative}]({images.name}/{family}.jpg)")
        for giver in population.givers:
            if giver.family == family:
                noise_floor = format_noise_floor([entries[giver.name]]) if giver.name in entries else NO_VALUE
                sections.append(format_card(population, giver, events.get(giver.name, {}), noise_floor))
    changed, n = count_changes(entries.values())
    setting = controls["setting"]
    sections.append(
        _CONTROLS.format(
            total=format_percent_rate(changed, n) if n else NO_VALUE,
            n=n,
            n_givers=sum(count_changes([entry])[1] > 0 for entry in entries.values()),
            n_all=len(population.givers),
            n_scenes=len(setting["scenes"]),
            scenes=", ".join(map(str, setting["scenes"])),
            table=format_controls(entries),
            **{key: value for key, value in setting.items() if key != "scenes"},
        )
    )
    sections += ["## Receivers", "These receivers are the partners of givers.", format_receivers(population.receivers)]
    return "\n\n".join(sections) + "\n"


_INTRODUCTION = """\
# Givers of strangers-v1

This page describes every giver of the population {population.label}, with which
[the protocol strangers](../how_to/strangers.md) evaluates receivers.

- **Limits**: `handover_marl.config.GiverConfig` limits the deviations of all givers from their recordings: at most
  0.3 m and 1 rad of displacement for each axis, 0.8 m/s, 5 m/s², 2.5 rad/s, 15 rad/s². The tables list the bounds of
  their own options.
- **Images**: the receiver `reactive` in scene 95 of the synthetic data set, fast physics. The first row replays the
  recording; its path of the wrist is orange in the other rows, the path of the giver is blue. Cells after the end of an
  episode are white.
- **Events**: means of three episodes with `reactive` on DexYCB, from the
  [selection of the population](../results/population.md); they describe the giver and are no estimates of success
  rates.
- **Outcomes changed by a perturbation**: the noise floor, see [controls](#controls); n is the number of perturbed
  episodes.

```bash
python experiments/strangers/render_image_grids.py --out docs/reference/strangers_v1
python experiments/strangers/make_cards.py --out docs/reference/strangers_v1.md
```"""

_CONTROLS = """\
## Controls

The controls show how much of a difference between partners or methods may come from other causes.

| control | what it shows |
|---|---|
| noise floor | share of episodes whose outcome changes if all joint targets of the robot are perturbed |
| random start | change of the success rate if the robot starts at another position |
| no preview | change of the success rate if a giver does not observe its recording's next half second |
| self-play against cross-play | difference between policies that were trained together and the same with others |

A perturbation adds {offset:g} rad with random signs to the seven joint targets of the whole episode; the giver's random
draws stay the same. Differences below the noise floor may be chance. {n_givers} of {n_all} givers have been
measured: {total} % of {n} outcomes changed. Random starts deviate by up to {start_noise:g} rad in each joint.

The table has {n_scenes} scenes of the {setup} {split} split of {dataset} ({scenes}), receiver `{receiver}`,
{physics} physics, version {version}. A dash stands for what has not been measured. Intervals are Wilson's for rates,
and Agresti and Min's for differences, which are paired by scene. The perturbed episodes of a scene are not independent,
so that the intervals of the noise floor are too narrow.

{table}

```bash
python experiments/strangers/measure_controls.py --data-dir DIR --out docs/results/data/strangers_controls.json
```

The script continues an existing output file. For your own receiver, add `--receiver` and another file. The option
`--initial-joint-noise 0.1` of `handover-marl pair` and `crossplay` draws other start positions, too.

### No preview

Observations of receivers contain no future motion: a change of later frames of the recording does not change them.
Givers observe where their own recording goes. The policies `learned` and `cooperative` use it; the other givers of the
population act the same without it. Tests verify both.

### Self-play against cross-play

The giver `learned` was trained with `yang2021`. Its gain over `replay` with this receiver is on the page
[results](../results/index.md#adaptive-givers), its gain with a receiver that it has not met in the table of
[`reactive` with other givers](../results/reactive.md#other-givers). The page
[training with a population](../results/population_training.md#settings-of-a-receiver) has receivers that were chosen
with one giver or with a population. To compare your own teams:

```bash
handover-marl crossplay --givers replay,learned --receivers yang2021,reactive --setup s0 --split val --physics fast
```"""


def main(args: Args) -> None:
    """Write the page."""
    population = load_population(args.population)
    controls = json.loads(args.controls.read_text())
    page = format_page(population, read_events(args.events), controls, args.out.with_suffix(""))
    write_atomically(args.out, page)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
