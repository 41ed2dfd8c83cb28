// Columns of quality on what was held out, the same in all tables of models, versions and jobs.

import { coverageBars, errorBars, mean } from "../charts.js";
import { h } from "../dom.js";
import { nmse, percent, shortNames } from "../format.js";
import { narrowJoints } from "./model/coverage.js";

/** What the columns mean, to stand below such a table. */
export const QUALITY_HINT = "nMSE and “in 95\u00a0%” are means of the joints, judged on held-out rows before the version was trained on all rows. Bars show each joint. nMSE: lower is better, 1 is no better than the mean torque. “In 95\u00a0%” should be near 95\u00a0%: less means that the bands are too narrow.";

/** Columns for rows whose quality and joints `of` returns: {quality, joints: names or null}. */
export function qualityColumns(of) {
  const names = ({ quality, joints }) => (joints ? shortNames(joints) : quality.nmse.map((_each, joint) => `joint ${joint + 1}`));
  const figure = (row, name, format, bars) => {
    const { quality, joints } = of(row);
    if (!quality) return h("span", { class: "muted", title: "Nothing was held out of its training" }, "not judged");
    const narrow = name === "coverage" && narrowJoints(quality).length > 0;
    return h("div", { class: "figure" }, h("span", { class: narrow ? "narrow" : null }, format(mean(quality[name]))), bars(names({ quality, joints }), quality[name]));
  };
  return [
    { label: "nMSE", value: (row) => mean(of(row).quality?.nmse), cell: (row) => figure(row, "nmse", nmse, errorBars) },
    { label: "In 95\u00a0%", value: (row) => mean(of(row).quality?.coverage), cell: (row) => figure(row, "coverage", (x) => percent(x, 0), coverageBars) },
  ];
}
