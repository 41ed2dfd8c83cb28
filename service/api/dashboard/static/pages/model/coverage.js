// Coverage of the 95 % intervals and its confidence interval, which depends on the number of effective samples.

import { jointVar } from "../../colours.js";
import { h } from "../../dom.js";
import { count, number, percent, shortNames } from "../../format.js";
import { card } from "../../ui.js";
import { jointBadge, verdictNote } from "../verdict.js";

const NOMINAL_COVERAGE = 0.95;
const BAR_KINDS = { wrong: "bad", too_uncertain: "warn" };

/** Describe the confidence interval of a joint's coverage; a dash if an import lacks it. */
export function coverageInterval(figures, joint) {
  if (!figures.independent) return "–";
  const [low, high] = [figures.coverage_low[joint], figures.coverage_high[joint]].map((each) => percent(each, 0));
  return `${low} to ${high} (${count(Math.round(figures.independent[joint]))} effective samples)`;
}

/** Return a card with the verdict of an evaluation, and error and coverage of each joint, which fits on a phone. */
export function verdictCard({ verdict, ...figures }) {
  const names = shortNames(figures.joint_names);
  return card(
    "Verdict on this recording",
    verdictNote(verdict),
    h("ul", { class: "verdicts" }, verdict.joints.map((each, joint) => h(
      "li",
      {},
      h("span", { class: "joint", style: `--own: ${jointVar(joint)}` }, names[joint]),
      h("span", { class: "numeric", title: errorTitle(each) }, `${number(each.rmse, 2)} ${each.unit}`, each.range_share === null ? null : h("span", { class: "muted" }, ` ${percent(each.range_share, 1)}`)),
      bar(figures, joint, each.level),
      h("span", { class: "numeric" }, `${percent(each.coverage)} coverage`),
      h("span", { class: "numeric" }, each.width_over_need === null ? "–" : `${number(each.width_over_need, 2)} × need`),
      jointBadge(each),
    ))),
    h("p", { class: "hint" }, "Error: RMSE, and its share of the range of the torque. Bars: coverage of the 95 % interval, the share of measurements inside; it should end at the mark. Thin lines: 95 % confidence interval of the coverage. Width: of the interval, relative to that of errors as large as the RMSE."),
  );
}

/** Return the errors that the error of a joint is compared with. */
function errorTitle({ unit, mean_rmse: mean, serving_rmse: serving, limit_share: limit }) {
  const others = [
    mean === null ? null : `mean torque: ${number(mean, 2)} ${unit}`,
    serving === null ? null : `serving version: ${number(serving, 2)} ${unit}`,
    limit === null ? null : `${percent(limit, 1)} of the rated torque`,
  ];
  return others.filter(Boolean).join("; ");
}

/** Return a bar of a coverage, from 50 to 100 %. */
function bar(figures, joint, level) {
  const at = (share) => 100 * Math.max(0, (share - 0.5) / 0.5);
  const share = figures.coverage[joint];
  const bounds = figures.independent ? [figures.coverage_low[joint], figures.coverage_high[joint]] : null;
  const confidence = bounds ? `, 95 % CI ${coverageInterval(figures, joint)}` : "";
  return h(
    "span",
    { class: `inside ${BAR_KINDS[level] ?? ""}`, role: "img", "aria-label": `95 % coverage: ${percent(share)}${confidence}` },
    h("i", { class: "filled", style: `width: ${at(share)}%` }),
    bounds ? h("i", { class: "known", style: `left: ${at(bounds[0])}%; width: ${at(bounds[1]) - at(bounds[0])}%` }) : null,
    h("i", { class: "due", style: `left: ${at(NOMINAL_COVERAGE)}%` }),
  );
}
