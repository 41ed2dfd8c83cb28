// The verdict on a version: badge, note, and figures by joint.

import { h } from "../dom.js";
import { badge } from "../ui.js";

const KINDS = { usable: "good", usable_in_range: "good", too_uncertain: "warn", wrong: "bad", not_judged: "plain" };

/** Return a badge with the level of a verdict, and its reason as a title. */
export function verdictBadge({ level, label, reason }) {
  const made = badge(label, KINDS[level]);
  made.title = reason;
  return made;
}

/** Return the badge of a joint's level. */
export function jointBadge({ level }) {
  return badge(level.replaceAll("_", " "), KINDS[level]);
}

/** Return a note with the level of a verdict, why, and what to do. */
export function verdictNote(verdict) {
  const body = [verdictBadge(verdict), ` ${verdict.reason} `, h("span", { class: "muted" }, verdict.action)];
  return h("p", { class: verdict.serves ? "verdict" : "verdict banner", role: "note" }, body);
}

/** Return figures by joint for the charts: {nmse, coverage}; null if the verdict has none. */
export function figuresOf(verdict) {
  if (!verdict?.joints.length) return null;
  const nmse = verdict.joints.map((each) => (each.mean_rmse ? (each.rmse / each.mean_rmse) ** 2 : null));
  return { nmse, coverage: verdict.joints.map((each) => each.coverage), joints: verdict.joints.map((each) => each.joint) };
}
