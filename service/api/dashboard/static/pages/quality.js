// Columns with the verdict on a version and its errors on held-out rows, for tables of models, versions and jobs.

import { coverageBars, mean } from "../charts.js";
import { h } from "../dom.js";
import { percent, shortNames } from "../format.js";
import { figuresOf, verdictBadge } from "./verdict.js";

/** Explanation of the columns, shown below a table. */
export const QUALITY_HINT = "Verdict: whether the torque can be used. Error: the largest RMSE of a joint, as a share of the range of its torque. 95\u00a0% coverage: share of the measurements inside the 95\u00a0% interval, mean over the joints. All are evaluated on held-out rows, before the version is trained on all rows.";

/** Return the columns. of(row): the verdict of the row's version; null without a version. */
export function qualityColumns(of) {
  const coverage = (row) => {
    const figures = figuresOf(of(row));
    if (!figures) return "–";
    return h("div", { class: "figure" }, h("span", {}, percent(mean(figures.coverage), 0)), coverageBars(shortNames(figures.joints), figures.coverage));
  };
  const error = (row) => {
    const shares = (of(row)?.joints ?? []).map((each) => each.range_share).filter((each) => each !== null);
    return shares.length ? Math.max(...shares) : null;
  };
  const reason = (row) => {
    const verdict = of(row);
    return verdict ? h("details", { class: "why" }, h("summary", {}, verdictBadge(verdict)), h("p", { class: "hint" }, verdict.reason, " ", verdict.action)) : "–";
  };
  return [
    { label: "Verdict", value: (row) => of(row)?.label ?? null, cell: reason },
    { label: "Error", value: error, cell: (row) => (error(row) === null ? "–" : percent(error(row), 1)) },
    { label: "95\u00a0% coverage", value: (row) => mean(figuresOf(of(row))?.coverage), cell: coverage },
  ];
}
