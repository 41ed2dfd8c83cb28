"""No block of the documentation is left out without one of the reasons that count."""

import pytest

from tests.docs.blocks import REASONS, RUN, blocks, pages
from tests.docs.expected import compare


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.stem)
def test_every_block_is_run_or_says_why_not(page):
    for block in blocks(page):
        known = block.language in RUN if block.reason is None else block.reason in REASONS
        assert known, f"{block.place} is {block.language or 'of no language'}: run it or say why not, {REASONS}"
    for before, block in zip([None, *blocks(page)], blocks(page), strict=False):
        if block.language == "json" and block.reason is None:  # output follows the command that prints it
            assert before is not None, block.place
            assert (before.reason, before.language == "json") == (None, False), block.place


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
    ("printed", "shown"),
    [
        ({"a": 1.2375}, '{"a": 1.235}'),
        ([1.0, 2.0], "[1.0]"),
        ({"id": "job_1"}, '{"id": "ds_…"}'),
        ({}, '{"a": null}'),
        ({"n": 3}, '{"n": 4}'),
    ],
)
def test_output_is_compared_to_the_digits_that_are_shown(printed, shown):
    compare({"a": 1.23456, "id": "ds_12345", "b": 2}, '{"a": 1.235, "id": "ds_…"}', "here")
    with pytest.raises(AssertionError, match="here"):
        compare(printed, shown, "here")
