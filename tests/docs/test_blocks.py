"""No block of the documentation is left out without one of the reasons that count."""

from __future__ import annotations

import json

import pytest

from tests.docs.blocks import REASONS, RUN, blocks, pages
from tests.docs.expected import compare


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.stem)
def test_every_block_is_run_or_says_why_not(page):
    for block in blocks(page):
        if block.reason is None:
            assert block.language in RUN, (
                f"{block.place} is {block.language or 'of no language'}: run it or say why not"
            )
        else:
            assert block.reason in REASONS, f"{block.place}: {block.reason!r} is no reason, expected one of {REASONS}"


def test_output_follows_the_command_that_prints_it():
    for page in pages():
        found = blocks(page)
        for before, block in zip([None, *found], found, strict=False):
            if block.language == "json" and block.reason is None:
                assert before is not None, block.place
                assert before.reason is None, block.place
                assert before.language != "json", block.place


PAGE = """a
```sh
one
```
<!-- not run: needs Docker -->

```sh
two
```
<!-- slow -->
```python
x

y
```
- item
  ```json
  {}
  ```
"""


def test_blocks_are_found_with_their_marks(tmp_path):
    (tmp_path / "page.md").write_text(PAGE)
    found = blocks(tmp_path / "page.md")
    assert [block.text for block in found] == ["one", "two", "x\n\ny", "{}"]
    assert [block.reason for block in found] == [None, "needs Docker", None, None]
    assert [block.slow for block in found] == [False, False, True, True]
    assert [block.line for block in found] == [2, 7, 11, 17]


@pytest.mark.parametrize(
    ("printed", "shown", "same"),
    [
        ({"a": 1.23456, "b": 2}, '{"a": 1.235}', True),
        ({"a": 1.2375}, '{"a": 1.235}', False),
        ([1.0, 2.0], "[1.0]", False),
        ({"id": "ds_12345"}, '{"id": "ds_…"}', True),
        ({"id": "job_1"}, '{"id": "ds_…"}', False),
        ({}, '{"a": null}', False),
        ({"n": 3}, '{"n": 4}', False),
    ],
)
def test_output_is_compared_to_the_digits_that_are_shown(printed, shown, same):
    printed = json.loads(json.dumps(printed))
    if same:
        compare(printed, shown, "here")
    else:
        with pytest.raises(AssertionError, match="here"):
            compare(printed, shown, "here")
