// Coverage of the 95 % intervals and its confidence interval, which depends on the number of effective samples.

import { jointVar } from "../../colours.js";
import { h } from "../../dom.js";
import { count, number, percent, scientific, shortNames } from "../../format.js";
import { badge, card } from "../../ui.js";

const MIN_COVERAGE = 0.9, NOMINAL_COVERAGE = 0.95, MAX_COVERAGE = 0.99;
/** Width of the 95 % interval of a normal error, in its standard deviations; largest width that is not called wide, in that of the errors. */
const NORMAL_WIDTH = 3.92, MAX_WIDTH = 2;

/** Return text and kind of a badge for the coverage of a joint. figures: {coverage, coverage_low, coverage_high, rmse, interval_width}; imported ones may lack all but the first, lists the last two. */
export function coverageVerdict(figures, joint) {
  const share = figures.coverage[joint];
  const [low, high] = [figures.coverage_low?.[joint] ?? share, figures.coverage_high?.[joint] ?? share];
  if (high < MIN_COVERAGE) return ["intervals too narrow", "bad"];
  if (share < MIN_COVERAGE) return ["too few samples", "warn"];
  const width = figures.interval_width?.[joint] / (NORMAL_WIDTH * figures.rmse?.[joint]);
  if (width > MAX_WIDTH) return [`intervals ${number(width, 2)} × as wide as needed`, "plain"];
  return share > MAX_COVERAGE && low > 0.95 ? ["intervals too wide", "plain"] : ["good", "good"];
}

/** Return the joints with significantly too narrow intervals. */
export function narrowJoints(figures) {
  return figures.coverage.map((_share, joint) => joint).filter((joint) => coverageVerdict(figures, joint)[1] === "bad");
}

/** Describe the confidence interval of a joint's coverage; a dash if an import lacks it. */
export function coverageInterval(figures, joint) {
  if (!figures.independent) return "–";
  const [low, high] = [figures.coverage_low[joint], figures.coverage_high[joint]].map((each) => percent(each, 0));
  return `${low} to ${high} (${count(Math.round(figures.independent[joint]))} effective samples)`;
}

/** Return a card with error and coverage of each joint, which fits on a phone. */
export function coverageCard(figures) {
  const names = shortNames(figures.joint_names);
  return card(
    "Accuracy by joint",
    h("ul", { class: "verdicts" }, names.map((name, joint) => h(
      "li",
      {},
      h("span", { class: "joint", style: `--own: ${jointVar(joint)}` }, name),
      h("span", { class: "numeric" }, h("span", { class: "muted" }, "nMSE "), scientific(figures.nmse[joint])),
      bar(figures, joint),
      h("span", { class: "numeric" }, `${percent(figures.coverage[joint])} coverage`),
      badge(...coverageVerdict(figures, joint)),
    ))),
    h("p", { class: "hint" }, "Bars: coverage of the 95 % interval, the share of measurements inside; it should end at the mark. Thin lines: 95 % confidence interval of the coverage. nMSE: mean squared error / variance of the torque; 0 is best."),
  );
}

/** Return a bar of a coverage, from 50 to 100 %. */
function bar(figures, joint) {
  const at = (share) => 100 * Math.max(0, (share - 0.5) / 0.5);
  const share = figures.coverage[joint];
  const bounds = figures.independent ? [figures.coverage_low[joint], figures.coverage_high[joint]] : null;
  const confidence = bounds ? `, 95 % CI ${coverageInterval(figures, joint)}` : "";
  return h(
    "span",
    { class: `inside ${coverageVerdict(figures, joint)[1]}`, role: "img", "aria-label": `95 % coverage: ${percent(share)}${confidence}` },
    h("i", { class: "filled", style: `width: ${at(share)}%` }),
    bounds ? h("i", { class: "known", style: `left: ${at(bounds[0])}%; width: ${at(bounds[1]) - at(bounds[0])}%` }) : null,
    h("i", { class: "due", style: `left: ${at(NOMINAL_COVERAGE)}%` }),
  );
}
