"""deploy/monitoring: the rules and the dashboard query metrics and labels that the service exports."""

import json
import re

import pytest
import yaml

from docs.metrics import KINDS
from service.contract.states import ACTIVE
from service.learning.ingest.monitor import WINDOWS_S
from service.training.ended import OUTCOMES
from tests import ROOT

FOLDER = ROOT / "deploy/monitoring"
ALERTS = yaml.safe_load((FOLDER / "alerts.yaml").read_text("utf-8"))
RULES = [rule for group in ALERTS["groups"] for rule in group["rules"]]
DASHBOARD = json.loads((FOLDER / "dashboard.json").read_text("utf-8"))
PANELS = [panel for panel in DASHBOARD["panels"] if panel["type"] != "row"]
TARGETS = [target for panel in PANELS for target in panel["targets"]]
EXPRESSIONS = [rule["expr"] for rule in RULES] + [target["expr"] for target in TARGETS]
METRIC = re.compile(r"\b((?:lipserve|process)_\w+)(?:\{(.*?)\})?")
MATCHER = re.compile(r'(\w+)(=~|!=|!~|=)"([^"]*)"')
GROUPED = re.compile(r"\b(?:by|on)\s*\(([\w, ]*)\)")
IN_TEXT = re.compile(r"\$labels\.(\w+)")
OF_TARGET = {"instance", "job"}
"""Labels that Prometheus adds to each series of a service."""
LABELS = {kind.name: {*kind.labels} for kind in KINDS}
for _kind in KINDS:
    if _kind.kind == "histogram":
        LABELS |= {f"{_kind.name}_{end}": {*_kind.labels} for end in ("sum", "count")}
        LABELS |= {f"{_kind.name}_bucket": {*_kind.labels, "le"}}
        del LABELS[_kind.name]
VALUES = {"state": set(ACTIVE), "outcome": set(OUTCOMES), "window": {f"{each:g}" for each in WINDOWS_S}}
"""Values that the labels of equality matchers may have."""


def labels_of(expression):
    """Return the labels that every metric of an expression has; fail for an unknown metric, label or value."""
    known = []
    for name, matchers in METRIC.findall(expression):
        labels = (LABELS[name] if name.startswith("lipserve_") else set()) | OF_TARGET
        for label, operator, value in MATCHER.findall(matchers):
            assert label in labels, f"{name} has no label {label}"
            assert operator != "=" or value in VALUES[label], f"{label} is never {value!r}"
        known.append(labels)
    assert known, expression
    return set.union(*known)


@pytest.mark.parametrize("expression", EXPRESSIONS)
def test_metrics_and_labels_exist(expression):
    known = labels_of(expression)
    for group in GROUPED.findall(expression):
        assert {each.strip() for each in group.split(",")} <= known


def grouped(expression):
    """Return the labels of the result of an expression: those of its first grouping."""
    found = GROUPED.search(expression)
    return set() if found is None else {each.strip() for each in found[1].split(",")} - {"le"}


def test_texts_name_labels_of_the_result():
    for rule in RULES:
        assert set(IN_TEXT.findall(rule["annotations"]["summary"])) <= grouped(rule["expr"]), rule["alert"]
    for target in TARGETS:
        assert set(re.findall(r"\{\{(\w+)\}\}", target["legendFormat"])) <= grouped(target["expr"]), target


def test_rules_have_the_fields_of_prometheus():
    names = [rule["alert"] for rule in RULES]
    assert len(set(names)) == len(names)
    for rule in RULES:
        assert set(rule) <= {"alert", "expr", "for", "labels", "annotations"}
        assert re.fullmatch(r"\d+[smh]", rule.get("for", "0s"))
        assert rule["labels"]["severity"] in ("critical", "warning", "info")


def test_rules_of_the_operator_are_the_same():
    component = ROOT / "deploy/kubernetes/monitoring"
    rules = yaml.safe_load((component / "prometheusrule.yaml").read_text("utf-8"))
    assert rules["spec"] == ALERTS


def test_panels_do_not_overlap():
    cells = set()
    for panel in DASHBOARD["panels"]:
        place = panel["gridPos"]
        own = {(place["x"] + i, place["y"] + j) for i in range(place["w"]) for j in range(place["h"])}
        assert not own & cells, panel["title"]
        cells |= own
    assert max(x for x, _ in cells) == 23
    assert len({panel["id"] for panel in DASHBOARD["panels"]}) == len(DASHBOARD["panels"])


@pytest.mark.slow
@pytest.mark.parametrize("expression", EXPRESSIONS)
def test_expressions_are_promql(expression):
    promql = pytest.importorskip("promql_parser")
    promql.parse(expression.replace("$__rate_interval", "5m"))
