"""`lipserve models`: what is served, and which of its versions answers."""

from __future__ import annotations

import sys
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer
from rich.markup import escape
from rich.table import Table

from lipserve.address import DEFAULT_URL
from service.cli import connecting
from service.cli.connecting import connected, dataset_of
from service.cli.consoles import CommandError, echo, note, out, print_json, print_result, print_warnings
from service.cli.options import Alias, Data, Json, Limit, Model, Promotion, Url, Version, Yes, confirm, group
from service.foundation.text import counted

if TYPE_CHECKING:
    from lipserve.records.models import Alias as AliasRecord
    from lipserve.records.models import Selection
    from lipserve.results.arm import Version as VersionRecord
    from service.contract.states import PromotionOption

app = group("Models: list, show, promote, roll back, compare, export, import and delete them.")
SERVING = "serving"
Which = Annotated[str, typer.Argument(help="A version, by its number or an alias.", autocompletion=connecting.versions)]
AliasName = Annotated[str, typer.Option("--alias", help="Which alias.", autocompletion=connecting.aliases)]


@app.command("list")
def list_(limit: Limit = 50, url: Url = DEFAULT_URL, as_json: Json = False) -> None:
    """List models, newest first."""
    with connected(url) as client:
        models = list(islice(client.models(), limit))
    if as_json:
        print_json(models)
        return
    if not models:
        echo("no model yet: `lipserve train FILE --model NAME` makes one")
        return
    from service.cli.tables import judged  # noqa: PLC0415 - takes long to import; help needs none

    table = Table("model", "serving", "nMSE held out", "in 95 %", "versions", "estimator", "aliases", "made")
    for model in models:
        serving = next((each for each in model.versions if each.version == model.serving_version), None)
        aliases = ", ".join(f"{name} → {at}" for name, at in model.aliases.items()) or "-"
        table.add_row(
            escape(model.name),
            str(model.serving_version or "none"),
            *judged(None if serving is None else serving.quality),
            str(len(model.versions)),
            "-" if serving is None else serving.estimator,
            escape(aliases),
            model.created_at[:16].replace("T", " "),
        )
    out.print(table)


@app.command()
def show(model: Model, version: Version = None, url: Url = DEFAULT_URL, as_json: Json = False) -> None:
    """Print a model with its versions, and what one of them stands on: the one that serves, or one that is named."""
    from lipserve import ApiError  # noqa: PLC0415 - takes long to import; help needs none
    from service.cli.tables import judged  # noqa: PLC0415 - as above

    with connected(url) as client:
        record = client.model(model)
        detail = client.version(model, version or record.serving_version or record.latest_version)
        try:
            learning = client.learning(model).status
        except ApiError:  # the version that serves cannot be read: the others can be shown all the same
            learning = None
    if as_json:
        print_json({"model": record, "version": detail, "learning": learning})
        return
    serving = "no version" if record.serving_version is None else f"version {record.serving_version}"
    echo(f"{record.name}: {serving} serves, {record.latest_version} is the newest")
    if learning is not None:
        held = ", held until you decide" if learning.held is not None else ""
        echo(f"  revision {learning.published} of {learning.revision} answers, learnt since it was trained{held}")
    table = Table("version", "nMSE held out", "in 95 %", "may answer", "estimator", "made", "named")
    for each in record.versions:
        named = [name for name, at in record.aliases.items() if at == each.version]
        named = [SERVING, *named] if each.version == record.serving_version else named
        at = each.created_at[:16].replace("T", " ")
        passed = None if each.promotion is None else each.promotion.passed
        may = {True: "yes", False: "no", None: "not judged"}[passed]
        table.add_row(
            str(each.version), *judged(each.quality), may, each.estimator, at, escape(", ".join(named)) or "-"
        )
    out.print(table)
    _print_version(detail)


@app.command()
def promote(
    model: Model, version: Which, alias: AliasName = SERVING, url: Url = DEFAULT_URL, as_json: Json = False
) -> None:
    """Let a version answer where none is named; with --alias, point that alias to it instead."""
    with connected(url) as client:
        moved = client.set_alias(model, alias, _which(version))
        judged = client.version(model, moved.version).promotion
    _moved(model, moved, as_json)
    if not as_json and judged is not None and not judged.passed:
        print_warnings([f"version {moved.version} would not answer by itself: {judged.reason}"])


@app.command()
def rollback(
    model: Model,
    alias: AliasName = SERVING,
    revision: Annotated[
        int | None,
        typer.Option(min=0, help="Instead: forget what the serving version learnt after this revision; 0: all of it."),
    ] = None,
    url: Url = DEFAULT_URL,
    as_json: Json = False,
) -> None:
    """Take back the last promotion, the next time the one before it; or what was learnt online since a revision."""
    with connected(url) as client:
        if revision is None:
            _moved(model, client.rollback_alias(model, alias), as_json)
            return
        back = client.rollback(model, revision=revision)
    print_result(
        back, as_json, f"{model} is back at revision {revision}: {counted(back.undone, 'batch', 'batches')} taken back"
    )


@app.command()
def alias(
    model: Model,
    name: Annotated[str, typer.Argument(help="The alias.", autocompletion=connecting.aliases)],
    version: Annotated[
        str | None,
        typer.Argument(
            help="The version it is to name, by number or another alias.", autocompletion=connecting.versions
        ),
    ] = None,
    remove: Annotated[bool, typer.Option("--remove", help="Remove it; its version stays.")] = False,
    url: Url = DEFAULT_URL,
    as_json: Json = False,
) -> None:
    """Print where an alias points and pointed, point it to a version, or remove it."""
    if remove and version is not None:
        raise CommandError("--remove and a version are given, expected one of them")
    with connected(url) as client:
        if remove:
            client.remove_alias(model, name)
            print_result({"removed": name}, as_json, f"alias {name} of {model} is removed")
            return
        if version is not None:
            _moved(model, client.set_alias(model, name, _which(version)), as_json)
            return
        aliases = [each for each in client.aliases(model) if each.alias == name]
    if not aliases:
        raise CommandError(f"no alias {name!r} of {model}", f"`lipserve models alias {model} {name} VERSION` makes it")
    moves = (
        f"  {move.at[:19].replace('T', ' ')}  {move.before or 'none'} → {move.version or 'none'}"
        + (" (rolled back)" if move.rollback else "")
        for move in aliases[0].history
    )
    print_result(aliases[0], as_json, f"{name} of {model} names version {aliases[0].version}", *moves)


@app.command()
def compare(
    model: Model, data: Data, first: Which, second: Which, url: Url = DEFAULT_URL, as_json: Json = False
) -> None:
    """Compare two versions on a recording: which is better, as far as the data can tell."""
    with connected(url) as client:
        comparison = client.compare(model, dataset_of(client, data), _which(first), _which(second))
    if as_json:
        print_json(comparison)
        return
    from service.cli.tables import comparison_table  # noqa: PLC0415 - takes long to import; help needs none

    out.print(comparison_table(comparison))
    echo(comparison.verdict)
    print_warnings(comparison.warnings)


@app.command("export")
def export_(
    model: Model,
    path: Annotated[Path | None, typer.Argument(help="Archive to write, .tar.", dir_okay=False)] = None,
    c: Annotated[
        Path | None,
        typer.Option("--c", help="Folder for lipserve_model.c and .h instead, for control loops.", file_okay=False),
    ] = None,
    version: Version = None,
    alias: Alias = None,
    learnt: Annotated[bool, typer.Option(help="With what it has learnt online; else as it was trained.")] = True,
    url: Url = DEFAULT_URL,
    as_json: Json = False,
) -> None:
    """Write a version as an archive that another service imports, or with --c as C99 for hard real time.

    The latter has torque and standard deviation of a model of rigid bodies (and `lip-chain`), also with a
    payload, without dependencies or allocation: `cc -O2 -c lipserve_model.c`; lipserve_model.h says how to use it.
    """
    if (path is None) == (c is None):
        raise CommandError("path and --c are " + ("missing" if c is None else "both given") + ", expected one of them")
    if c is not None:
        with connected(url) as client:
            client.export(model, c, version, alias, learnt, format="c")
        source, header = c / "lipserve_model.c", c / "lipserve_model.h"
        text = f"{source} and {header}: {source.stat().st_size:,} bytes; `cc -O2 -c {source}` compiles it"
        print_result({"source": source, "header": header}, as_json, text)
        return
    assert path is not None
    with connected(url) as client:
        written = client.export(model, path, version, alias, learnt)
    size = written.stat().st_size
    print_result(
        {"file": written, "bytes": size},
        as_json,
        f"{written}: {size:,} bytes; `lipserve models import {written}` reads it",
    )


@app.command()
def urdf(
    model: Model, version: Version = None, alias: Alias = None, url: Url = DEFAULT_URL, as_json: Json = False
) -> None:
    """Print the arm that a version has learnt as a URDF: `lipserve models urdf NAME > arm.urdf`."""
    with connected(url) as client:
        text = client.urdf(model, version, alias)
    if as_json:
        print_json({"urdf": text})
    else:
        sys.stdout.write(text)


@app.command("import")
def import_(
    path: Annotated[Path, typer.Argument(help="Archive that was exported.", exists=True, dir_okay=False)],
    name: Annotated[str | None, typer.Option(help="Of the model; that of the archive by default.")] = None,
    promotion: Promotion = None,
    url: Url = DEFAULT_URL,
    as_json: Json = False,
) -> None:
    """Make a new version of an exported archive. It answers if the model had none before, and if it does well on what
    its training held out."""
    with connected(url) as client:
        made = client.import_model(path, name, cast("PromotionOption | None", promotion))
    what, judged = f"{made.model} version {made.version} is imported", made.promotion
    assert judged is not None
    promote = f"`lipserve models promote {made.model} {made.version}` lets it answer"
    print_result(
        made, as_json, f"{what} and answers" if judged.answers else f"{what} and waits: {judged.reason}; {promote}"
    )


@app.command()
def delete(
    model: Model, version: Version = None, yes: Yes = False, url: Url = DEFAULT_URL, as_json: Json = False
) -> None:
    """Delete a version that nothing needs, or a model with all that it has observed and learnt: for good."""
    what = f"model {model} with all its versions and all it has learnt" if version is None else f"{model} {version}"
    confirm(f"delete {what} for good?", yes)
    with connected(url) as client:
        if version is None:
            client.delete_model(model)
        else:
            client.delete_version(model, version)
    print_result({"deleted": {"model": model, "version": version}}, as_json, f"{what} is deleted")


def _which(text: str) -> int | str:
    return int(text) if text.isdecimal() else text


def _moved(model: str, moved: AliasRecord, as_json: bool) -> None:
    if as_json:
        print_json(moved)
        return
    did = "answers where none is named" if moved.alias == SERVING else f"is what {moved.alias} names"
    echo(f"{model}: version {moved.version} {did}")
    if moved.previous is not None:
        note(f"`lipserve models rollback {model} --alias {moved.alias}` goes back to version {moved.previous}")


def print_selection(selection: Selection) -> None:
    """Print how an estimator was chosen."""
    from service.cli.tables import selection_table  # noqa: PLC0415 - takes long to import; help needs none

    out.print(selection_table(selection))
    echo(f"  {selection.chosen} is chosen: {selection.reason}")
    if selection.held_out.repeats:
        echo("  the held-out motion repeats the training motion: these figures flatter, except at the edge")


def print_held_out(version: VersionRecord) -> None:
    """Print how well a version predicts what its training held out."""
    from service.cli.tables import figures_table  # noqa: PLC0415 - takes long to import; help needs none

    held = version.lineage["holdout"]
    out.print(figures_table(f"on {counted(held['samples'], 'sample')} held out", version.joint_names, held))
    if held.get("learnt"):
        echo("  Judged on held-out rows; the version was then trained on all rows.")
    print_warnings(held.get("warnings", ()))


def print_promotion(version: VersionRecord) -> None:
    """Print why a version answers by itself, or does not; nothing of one that was refreshed or shipped."""
    judged = version.promotion
    if judged is None:
        return
    if judged.passed:
        echo(f"  it answers by itself: {judged.reason}")
    else:
        print_warnings([judged.reason])


def _print_guarantee(conformal: dict[str, Any]) -> None:
    """What left-out blocks of the training say of the intervals."""
    least, widest = min(conformal["guaranteed"]), max(conformal["scale"])
    blocks = "1 block" if conformal["blocks"] == 1 else f"{conformal['blocks']} blocks"
    wider = "as wide as believed" if widest == 1 else f"up to {widest:.2f} times as wide as believed"
    few = "; more would guarantee 95 %" if least < 0.95 - 1e-9 else ""
    echo(f"  intervals {wider}: {blocks} left out in turn guarantee {100 * least:.0f} % of such motion{few}")


def print_of_joints(version: VersionRecord) -> None:
    """What the fit reports joint by joint."""
    joints = {
        "right_angle_": "axes at right angles, how probably",
        "local_": "corrected where the motion repeats, error that is left",
        "widened_": "intervals widened by what was held out",
    }
    for prefix, text in joints.items():
        found = {int(key.removeprefix(prefix)): value for key, value in version.fit.items() if key.startswith(prefix)}
        if found:
            echo(f"  {text}: {', '.join(f'{version.joint_names[j - 1]} {found[j]:.2g}' for j in sorted(found))}")


def _print_version(version: VersionRecord) -> None:
    names = version.joint_names
    echo(f"version {version.version}: {version.estimator}, {counted(len(names), 'joint')}: {', '.join(names)}")
    noise = ", ".join(f"{value:.3g}" for value in version.noise_std)
    echo(f"  torque {version.torque_convention.replace('_', ' ')}, noise of a measurement {noise} N·m")
    if version.selection is not None:
        print_selection(version.selection)
    lineage: dict[str, Any] = version.lineage
    sets = [each.get("name") or each.get("id") for each in lineage.get("datasets") or () if isinstance(each, dict)]
    if sets:
        echo(f"  trained on {', '.join(map(str, sets))}")
    if (independent := version.fit.get("independent_samples")) is not None:
        echo(f"  {counted(version.fit['samples_given'], 'sample')}, worth {round(independent)} independent ones")
    if version.conformal is not None:
        _print_guarantee(version.conformal)
    print_of_joints(version)
    if lineage.get("holdout") is not None:
        print_held_out(version)
    else:
        echo("  nothing was held out of its data: `lipserve evaluate` on a recording it has not seen tells how good")
    print_promotion(version)
    print_warnings(version.warnings)
    arm = version.arm
    if arm is not None:
        from lipserve.results.arm import LIMITS  # noqa: PLC0415
        from service.cli.tables import arm_tables  # noqa: PLC0415 - as above

        for table in arm_tables(arm):
            out.print(table)
        for text in LIMITS:
            echo(text)
