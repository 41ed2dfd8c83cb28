// What a coverage says of a 95 % band, and how far it is known: 85 % of ten errors is not 85 % of a thousand.

import { count, percent } from "../../format.js";

const NARROW = 0.9, WIDE = 0.99;

/** Words and sign of a badge for one joint of figures: {coverage, coverage_low, coverage_high}; older ones lack bounds. */
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

/** The bounds of one joint's coverage, and of how many independent errors; a dash where older figures lack them. */
export function known(figures, joint) {
  if (!figures.independent) return "–";
  const [low, high] = [figures.coverage_low[joint], figures.coverage_high[joint]].map((each) => percent(each, 0));
  return `${low} to ${high}, by ${count(Math.round(figures.independent[joint]))}`;
}
