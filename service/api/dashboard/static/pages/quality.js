// Columns with the quality on held-out rows, for tables of models, versions and jobs.

import { coverageBars, errorBars, mean } from "../charts.js";
import { h } from "../dom.js";
import { nmse, percent, shortNames } from "../format.js";
import { narrowJoints } from "./model/coverage.js";

/** Explanation of the columns, shown below a table. */
export const QUALITY_HINT = "nMSE and 95\u00a0% coverage are means over the joints; bars show each joint. Both are evaluated on held-out rows, before the version is trained on all rows. nMSE: lower is better; 1 is no better than the mean torque. Coverage should be near 95\u00a0%; less means that the intervals are too narrow.";

/** Return the columns. of(row): {quality, joints}; joints: names, null if unknown. */
export function qualityColumns(of) {
  const names = ({ quality, joints }) => (joints ? shortNames(joints) : quality.nmse.map((_each, joint) => `joint ${joint + 1}`));
  const figure = (row, name, format, bars) => {
    const { quality, joints } = of(row);
    if (!quality) return h("span", { class: "muted", title: "No rows were held out of the training" }, "not evaluated");
    const narrow = name === "coverage" && narrowJoints(quality).length > 0;
    return h("div", { class: "figure" }, h("span", { class: narrow ? "narrow" : null }, format(mean(quality[name]))), bars(names({ quality, joints }), quality[name]));
  };
  return [
    { label: "nMSE", value: (row) => mean(of(row).quality?.nmse), cell: (row) => figure(row, "nmse", nmse, errorBars) },
    { label: "95\u00a0% coverage", value: (row) => mean(of(row).quality?.coverage), cell: (row) => figure(row, "coverage", (x) => percent(x, 0), coverageBars) },
  ];
}
