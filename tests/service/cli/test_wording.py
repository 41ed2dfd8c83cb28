"""Messages of the service with command line options instead of API fields."""

import pytest
import typer

from lipserve.asking import Reading
from service.cli.data import app
from service.cli.wording import FLAGS, in_shell
from service.datasets.mapping.recognition import columns_hint

SAID = {
    'are these degrees? Then say units={"q": "deg"}': "are these degrees? Then say --unit q=deg",
    'seconds, or its unit: units={"t": "ms"} if it is ms': "seconds, or its unit: --unit t=ms if it is ms",
    f"or {columns_hint({'tau': '…{joint}…'})} if called so": "or --column 'tau=…{joint}…' if called so",
    'columns={"tau": ["a", "b c"]} reads that': "--column 'tau=a,b c' reads that",
    "leave out locked joints, drop_joints=joint3": "leave out locked joints, --drop joint3",
    "or effort=current.": "or --effort current.",
    "torque_factors=-1,1 mends it": "--torque-factors=-1,1 mends it",
    "say joint_names, or leave out with drop_joints": "say --joint-names, or leave out with --drop",
    "move it, or leave it out with `drop_joints`": "move it, or leave it out with `--drop`",
    "holdout.share is 3.0, expected less": "--hold-out is 3.0, expected less",
    "units.q is foo, expected rad": "--unit q is foo, expected rad",
    "options.starts is 0, expected more": "--option starts is 0, expected more",
    'units={"q": "deg", "t": "ms"}, drop_joints=a': "--unit q=deg --unit t=ms, --drop a",
}


@pytest.mark.parametrize("said", SAID)
def test_api_fields_become_command_line_options(said):
    assert in_shell(said) == SAID[said]


@pytest.mark.parametrize(
    "said",
    [
        "read the file again with `--torque-factors=-1,1`",
        "row 41 is 29 values, expected 30 values",
        "the joints of the model, joint1: the rate is 3 Hz",
        'columns={"broken": is no JSON',
        "no model 'effort'",
        "expected a version with the joints of the data; that has other joint_names than the data",
    ],
)
def test_other_sentences_are_unchanged(said):
    assert in_shell(said) == said


def test_every_upload_option_has_a_flag():
    command = next(each for each in typer.main.get_command(app).commands.values() if each.name == "add")
    options = {option for parameter in command.params for option in parameter.opts}
    assert {FLAGS[name] for name in Reading.__annotations__} <= options
