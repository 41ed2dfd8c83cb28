"""`lipserve models`: models, their versions and aliases."""

from __future__ import annotations

from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer
from rich.markup import escape
from rich.table import Table

from lipcore.vocabulary import ExportFormat
from lipserve.address import DEFAULT_URL
from service.cli import connecting
from service.cli.connecting import connected, dataset_of
from service.cli.consoles import CommandError, echo, note, out, print_json, print_result, print_warnings
from service.cli.options import Data, Json, Limit, Model, ModelVersion, Promotion, Url, Yes, confirm, group
from service.cli.versions import print_version
from service.foundation.text import counted, percent

if TYPE_CHECKING:
    from lipserve.records.models import Alias as AliasRecord
    from lipserve.records.models import AliasMove
    from lipserve.records.models import Model as ModelRecord
    from service.contract.states import PromotionOption

app = group("List, show, promote, roll back, alias, compare, export, import and delete models.")
SERVING = "serving"
Which = Annotated[str, typer.Argument(help="Version number or alias.", autocompletion=connecting.versions)]
Override = Annotated[bool, typer.Option("--override", help="Promote a version that is not usable by its verdict.")]
AliasName = Annotated[str, typer.Option("--alias", help="Alias to move.", autocompletion=connecting.aliases)]


@app.command("list")
def list_(limit: Limit = 50, url: Url = DEFAULT_URL, as_json: Json = False) -> None:
    """List models, newest first."""
    with connected(url) as client:
        models = list(islice(client.models(), limit))
    if as_json:
        print_json(models)
        return
    if not models:
        echo("no models yet: `lipserve train FILE --model NAME` makes one")
        return
    from service.cli.tables import verdict_cells  # noqa: PLC0415 - slow import, not needed for help

    table = Table(
        "model", "serving", "verdict", "max error of range", "coverage", "versions", "estimator", "aliases", "created"
    )
    for model in models:
        serving = next((each for each in model.versions if each.version == model.serving_version), None)
        aliases = ", ".join(f"{name} → {at}" for name, at in model.aliases.items()) or "-"
        table.add_row(
            escape(model.name),
            str(model.serving_version or "none"),
            *verdict_cells(None if serving is None else serving.verdict),
            str(len(model.versions)),
            "-" if serving is None else serving.estimator,
            escape(aliases),
            model.created_at[:16].replace("T", " "),
        )
    out.print(table)


@app.command()
def show(model: ModelVersion, url: Url = DEFAULT_URL, as_json: Json = False) -> None:
    """Print a model with its versions, and details of one version (default: the serving version)."""
    from lipserve import ApiError  # noqa: PLC0415 - slow import, not needed for help
    from lipserve.call import split_name  # noqa: PLC0415 - as above
    from service.cli.tables import verdict_cells  # noqa: PLC0415 - as above

    with connected(url) as client:
        name, which = split_name(model)
        record = client.model(name)
        detail = client.version(name, _number(record, **which))
        aliases = client.aliases(name)
        try:
            learning = client.learning(name).status
        except ApiError:  # the serving version cannot be read; show the others
            learning = None
    if as_json:
        print_json({"model": record, "version": detail, "learning": learning})
        return
    serving = "none" if record.serving_version is None else f"version {record.serving_version}"
    echo(f"{record.name}: serving {serving}, newest version {record.latest_version}")
    for moved in aliases:
        if moved.alias == SERVING and moved.history[0].before is not None:
            echo(f"  {_move(moved.history[0])}")
    if learning is not None:
        paused = "; learning is paused until you decide" if learning.held is not None else ""
        learnt = f"revision {learning.published} of {learning.revision} serving"
        echo(f"  online learning: {learnt if learning.revision else 'nothing learnt yet'}{paused}")
        for made in learning.exports:
            state = "outdated" if made.outdated else "current"
            at = made.at[:16].replace("T", " ")
            echo(f"  exported as {made.format}: version {made.version}, revision {made.revision}, {at}: {state}")
    noted = any(each.note or each.tags for each in record.versions)
    table = Table("version", "verdict", "max error of range", "coverage", "estimator", "created", "aliases")
    if noted:
        table.add_column("note and tags")
    for each in record.versions:
        named = [name for name, at in record.aliases.items() if at == each.version]
        named = [SERVING, *named] if each.version == record.serving_version else named
        at = each.created_at[:16].replace("T", " ")
        cells = verdict_cells(each.verdict)
        words = escape(" ".join([each.note or "", *(f"[{tag}]" for tag in each.tags)]).strip()) or "-"
        table.add_row(str(each.version), *cells, each.estimator, at, escape(", ".join(named)) or "-", *[words] * noted)
    out.print(table)
    print_version(detail)


@app.command()
def promote(
    model: Model,
    version: Which,
    alias: AliasName = SERVING,
    override: Override = False,
    url: Url = DEFAULT_URL,
    as_json: Json = False,
) -> None:
    """Make a version the serving version; with --alias, point that alias to it instead.

    A version that is not usable by its verdict needs --override.
    """
    with connected(url) as client:
        moved = client.set_alias(model, alias, _which(version), override=override)
    _moved(model, moved, as_json)


@app.command()
def rollback(
    model: Model,
    alias: AliasName = SERVING,
    revision: Annotated[
        int | None,
        typer.Option(min=0, help="Instead, undo online learning of the serving version after this revision; 0: all."),
    ] = None,
    url: Url = DEFAULT_URL,
    as_json: Json = False,
) -> None:
    """Undo the last promotion (if repeated, the one before it), or online learning after a revision."""
    with connected(url) as client:
        if revision is None:
            _moved(model, client.rollback_alias(model, alias), as_json)
            return
        back = client.rollback(model, revision=revision)
    print_result(
        back,
        as_json,
        f"{counted(back.undone, 'batch', 'batches')} undone that {model} learnt after revision {revision}; the result "
        f"is revision {back.revision}",
    )


@app.command()
def alias(
    model: Model,
    name: Annotated[str, typer.Argument(help="Name of the alias.", autocompletion=connecting.aliases)],
    version: Annotated[
        str | None,
        typer.Argument(help="Version to point it to: number or another alias.", autocompletion=connecting.versions),
    ] = None,
    remove: Annotated[bool, typer.Option("--remove", help="Remove the alias. Its version stays.")] = False,
    override: Override = False,
    url: Url = DEFAULT_URL,
    as_json: Json = False,
) -> None:
    """Print an alias with its history, point it to a version, or remove it."""
    if remove and version is not None:
        raise CommandError("give either --remove or a version, not both")
    with connected(url) as client:
        if remove:
            client.remove_alias(model, name)
            print_result({"removed": name}, as_json, f"alias {name} of {model} removed")
            return
        if version is not None:
            _moved(model, client.set_alias(model, name, _which(version), override=override), as_json)
            return
        aliases = [each for each in client.aliases(model) if each.alias == name]
    if not aliases:
        raise CommandError(
            f"{model} has no alias {name!r}", f"`lipserve models alias {model} {name} VERSION` creates it"
        )
    moves = (f"  {_move(each)}" for each in aliases[0].history)
    print_result(aliases[0], as_json, f"{name} → {model} version {aliases[0].version}", *moves)


@app.command()
def thresholds(
    model: Model,
    max_error: Annotated[
        float | None, typer.Option(help="Max mean squared error of a joint, as a share of its torque's variance.")
    ] = None,
    min_coverage: Annotated[float | None, typer.Option(help="Min coverage of the 95 % intervals.")] = None,
    max_width: Annotated[
        float | None, typer.Option(help="Max width of the 95 % intervals, relative to those of the mean torque.")
    ] = None,
    url: Url = DEFAULT_URL,
    as_json: Json = False,
) -> None:
    """Print the thresholds of a model's verdicts, or set some of them; the others stay."""
    asked = {"max_error": max_error, "min_coverage": min_coverage, "max_width": max_width}
    changed = {name: value for name, value in asked.items() if value is not None}
    with connected(url) as client:
        known = client.model(model).thresholds
        if changed:
            before = {name: getattr(known, name) for name in asked}
            known = client.set_thresholds(model, **{**before, **changed}).thresholds
    print_result(
        known,
        as_json,
        f"{model}: a version is wrong if the squared error of a joint is above {known.max_error:g} of its variance, or "
        f"coverage below {percent(known.min_coverage)}; too uncertain if intervals are wider than {known.max_width:g} "
        "times those of the mean torque",
    )


@app.command("note")
def annotate(
    model: ModelVersion,
    text: Annotated[str | None, typer.Argument(help='The note; "" removes it.')] = None,
    tag: Annotated[
        list[str] | None, typer.Option(help='Tag; may be repeated. Replaces all tags; "" removes them.')
    ] = None,
    url: Url = DEFAULT_URL,
    as_json: Json = False,
) -> None:
    """Print the note and the tags of a version (default: the serving version), or set them."""
    from lipserve.call import split_name  # noqa: PLC0415 - slow import, not needed for help

    with connected(url) as client:
        name, which = split_name(model)
        version = _number(client.model(name), **which)
        if text is None and tag is None:
            found = client.version(name, version)
        else:
            found = client.annotate(name, version, text, None if tag is None else [each for each in tag if each])
    tags = f"tags: {', '.join(found.tags)}" if found.tags else "no tags"
    shown = {"note": found.note, "tags": found.tags}
    print_result(shown, as_json, f"{name} version {version}: {found.note or 'no note'}; {tags}")


@app.command()
def compare(
    model: Model, data: Data, first: Which, second: Which, url: Url = DEFAULT_URL, as_json: Json = False
) -> None:
    """Compare two versions on a recording, with the uncertainty of the difference."""
    with connected(url) as client:
        comparison = client.compare(model, dataset_of(client, data), _which(first), _which(second))
    if as_json:
        print_json(comparison)
        return
    from service.cli.tables import comparison_table  # noqa: PLC0415 - slow import, not needed for help

    out.print(comparison_table(comparison))
    echo(comparison.verdict)
    print_warnings(comparison.warnings)


@app.command("export")
def export_(
    model: ModelVersion,
    path: Annotated[Path, typer.Argument(help="File to write; for c, onnx and jax, the folder.")],
    format: Annotated[  # noqa: A002 - the option's name
        ExportFormat, typer.Option(help="archive: for another service. urdf, mjcf, c: rigid-body models only.")
    ] = "archive",
    learnt: Annotated[
        bool, typer.Option(help="Include what was learnt online, or export the version as trained.")
    ] = True,
    url: Url = DEFAULT_URL,
    as_json: Json = False,
) -> None:
    """Export a version: archive for another service, URDF, MJCF for MuJoCo, C99 code for hard real time, or a function.

    URDF and MJCF have physically possible bodies, friction and rotors. Comments state the largest torque error of each
    joint. The C code computes torque and standard deviation, with or without a payload. It has no dependencies and does
    not allocate memory; see lipserve_model.h for its use.

    onnx writes a model repository that onnxruntime and Triton load, torch an archive of torch.export, jax functions of
    jax.export. They load without LIPServe and compute torque and standard deviation of a batch of states.
    """
    with connected(url) as client:
        written = client.export(model, path, learnt=learnt, format=format)
    files = [each for each in written.rglob("*") if each.is_file()] if written.is_dir() else [written]
    size = sum(each.stat().st_size for each in files)
    notes = {
        "archive": f"; `lipserve models import {written}` imports it",
        "c": f"; `cc -O2 -c {written / 'lipserve_model.c'}` compiles it",
    }
    print_result(
        {"path": written, "format": format, "bytes": size}, as_json, f"{written}: {size:,} bytes{notes.get(format, '')}"
    )


@app.command("import")
def import_(
    path: Annotated[Path, typer.Argument(help="Exported archive.", exists=True, dir_okay=False)],
    name: Annotated[str | None, typer.Option(help="Name of the model. Default: the name in the archive.")] = None,
    promotion: Promotion = None,
    url: Url = DEFAULT_URL,
    as_json: Json = False,
) -> None:
    """Import an exported archive as a new version.

    It becomes the serving version if the model had none before and its held-out figures are good enough.
    """
    with connected(url) as client:
        made = client.import_model(path, name, cast("PromotionOption | None", promotion))
    what, decision = f"{made.model} version {made.version} imported", made.promotion
    assert decision is not None
    promote = f"`lipserve models promote {made.model} {made.version}` makes it the serving version"
    print_result(
        made,
        as_json,
        f"{what}: now serving" if decision.answers else f"{what}: candidate, not serving: {decision.reason}; {promote}",
    )


@app.command()
def delete(
    model: Model,
    version: Annotated[
        int | None,
        typer.Option(help="Delete only this version. Default: the whole model.", autocompletion=connecting.versions),
    ] = None,
    yes: Yes = False,
    url: Url = DEFAULT_URL,
    as_json: Json = False,
) -> None:
    """Permanently delete a model with its versions and observations, or one version that is not in use."""
    what = f"model {model} with all its versions and observations" if version is None else f"{model} version {version}"
    confirm(f"Delete {what} permanently?", yes)
    with connected(url) as client:
        if version is None:
            client.delete_model(model)
        else:
            client.delete_version(model, version)
    print_result({"deleted": {"model": model, "version": version}}, as_json, f"{what} deleted")


def _number(record: ModelRecord, version: int | None = None, alias: str | None = None) -> int:
    """Return the number of a version; raise CommandError for an unknown alias."""
    if alias in (None, SERVING):
        return version or record.serving_version or record.latest_version
    if alias not in record.aliases:
        raise CommandError(
            f"{record.name} has no alias {alias!r}", f"its aliases: {', '.join(record.aliases) or 'none'}"
        )
    return record.aliases[alias]


def _move(move: AliasMove) -> str:
    what = f"{move.at[:19].replace('T', ' ')}  {move.before or 'none'} → {move.version or 'none'}"
    return what + (" (rolled back)" if move.rollback else "")


def _which(text: str) -> int | str:
    return int(text) if text.isdecimal() else text


def _moved(model: str, moved: AliasRecord, as_json: bool) -> None:
    if as_json:
        print_json(moved)
        return
    echo(f"{moved.alias} → {model} version {moved.version}")
    if moved.previous is not None:
        note(f"`lipserve models rollback {model} --alias {moved.alias}` returns to version {moved.previous}")
