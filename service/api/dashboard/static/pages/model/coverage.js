// Confidence interval of the coverage of 95 % intervals, which depends on the number of effective samples.

import { count, percent } from "../../format.js";

/** Describe the confidence interval of a joint's coverage; a dash if an import lacks it. */
export function coverageInterval(figures, joint) {
  if (!figures.independent) return "–";
  const [low, high] = [figures.coverage_low[joint], figures.coverage_high[joint]].map((each) => percent(each, 0));
  return `${low} to ${high} (${count(Math.round(figures.independent[joint]))} effective samples)`;
}
