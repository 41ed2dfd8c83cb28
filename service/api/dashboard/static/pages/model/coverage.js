// What a coverage says of a 95 % band, and how far it is known: 85 % of ten errors is not 85 % of a thousand.

import { jointVar } from "../../colours.js";
import { h } from "../../dom.js";
import { count, percent, scientific, shortNames } from "../../format.js";
import { badge, card } from "../../ui.js";

const NARROW = 0.9, DUE = 0.95, WIDE = 0.99;

/** Words and sign of a badge for one joint of figures: {coverage, coverage_low, coverage_high}; those of an import may lack bounds. */
export function coverageVerdict(figures, joint) {
  const share = figures.coverage[joint];
  const [low, high] = [figures.coverage_low?.[joint] ?? share, figures.coverage_high?.[joint] ?? share];
  if (high < NARROW) return ["bands too narrow here", "bad"];
  if (share < NARROW) return ["too few errors to tell", "warn"];
  return share > WIDE && low > 0.95 ? ["bands wide here", "plain"] : ["about right", "good"];
}

/** Joints whose bands are too narrow, as far as can be told. */
export function narrowJoints(figures) {
  return figures.coverage.map((_share, joint) => joint).filter((joint) => coverageVerdict(figures, joint)[1] === "bad");
}

/** The bounds of one joint's coverage, and of how many independent errors; a dash where those of an import lack them. */
export function known(figures, joint) {
  if (!figures.independent) return "–";
  const [low, high] = [figures.coverage_low[joint], figures.coverage_high[joint]].map((each) => percent(each, 0));
  return `${low} to ${high}, by ${count(Math.round(figures.independent[joint]))}`;
}

/** What every joint's error and coverage come to, in a form that a phone shows as a whole. */
export function verdicts(figures) {
  const names = shortNames(figures.joint_names);
  return card(
    "Joint by joint",
    h("ul", { class: "verdicts" }, names.map((name, joint) => h(
      "li",
      {},
      h("span", { class: "joint", style: `--own: ${jointVar(joint)}` }, name),
      h("span", { class: "numeric" }, h("span", { class: "muted" }, "nMSE "), scientific(figures.nmse[joint])),
      bar(figures, joint),
      h("span", { class: "numeric" }, `${percent(figures.coverage[joint])} inside`),
      badge(...coverageVerdict(figures, joint)),
    ))),
    h("p", { class: "hint" }, "Bars: the share of measurements inside the 95 % band; it should end at the mark. Thin lines: where that share lies with 95 % confidence, as neighbouring errors are alike. nMSE: mean squared error / variance of the torque; 0 is best."),
  );
}

/** A coverage from 50 to 100 %, below which it is clear enough that something is wrong. */
function bar(figures, joint) {
  const at = (share) => 100 * Math.max(0, (share - 0.5) / 0.5);
  const share = figures.coverage[joint];
  const bounds = figures.independent ? [figures.coverage_low[joint], figures.coverage_high[joint]] : null;
  const told = bounds ? `; known to be ${known(figures, joint)} independent errors` : "";
  return h(
    "span",
    { class: `inside ${coverageVerdict(figures, joint)[1]}`, role: "img", "aria-label": `${percent(share)} of the measurements inside the 95 % band${told}` },
    h("i", { class: "filled", style: `width: ${at(share)}%` }),
    bounds ? h("i", { class: "known", style: `left: ${at(bounds[0])}%; width: ${at(bounds[1]) - at(bounds[0])}%` }) : null,
    h("i", { class: "due", style: `left: ${at(DUE)}%` }),
  );
}
