// Summary of a data set's report: key figures, warnings and recommendations.

import { jointVar } from "../../colours.js";
import { h } from "../../dom.js";
import { count, counted, number, seconds, shortNames, when } from "../../format.js";
import { card, facts } from "../../ui.js";
import { prose, warningBanner } from "./prose.js";

const CONVENTIONS = { gravity_included: "gravity included", gravity_compensated: "gravity compensated" };
const MAX_VISIBLE = 3; // recommendations that are visible at once

/** Return warnings and recommendations, the most important first. */
export function recommendations({ report, joint_names: joints }) {
  const [first, rest] = [report.advice.slice(0, MAX_VISIBLE), report.advice.slice(MAX_VISIBLE)];
  const list = (texts, start) => h("ol", { class: "advice", start: String(start) }, texts.map((text) => h("li", {}, withJoints(text, joints))));
  const made = card(
    "Recommendations",
    first.length ? list(first, 1) : h("p", {}, "✓ None. The recording is good for training."),
    rest.length ? h("details", {}, h("summary", {}, `${rest.length} more`), list(rest, MAX_VISIBLE + 1)) : null,
  );
  made.classList.add("todo");
  if (!first.length) made.classList.add("done");
  return [warningBanner(report.warnings), made];
}

/** Show the joints at the beginning of a sentence in their colours. */
function withJoints(text, joints) {
  const [, who, what] = /^([^:]+): (.*)$/s.exec(text) ?? [null, "", text];
  const named = who.split(/, | and /);
  if (!who || !named.every((each) => joints.includes(each))) return prose(text);
  const names = shortNames(joints);
  const all = named.length === joints.length && joints.length > 1;
  const marks = named.map((each) => h("span", { class: "joint", style: `--own: ${jointVar(joints.indexOf(each))}` }, names[joints.indexOf(each)]));
  return [h("span", { class: "who" }, all ? "All joints" : marks), " ", prose(what)];
}

/** Return the key figures in one line; the reader can open the rest. */
export function summary({ report, joint_names: joints, ...dataset }) {
  const line = [
    `${counted(report.rows, "sample")} of ${counted(joints.length, "joint")}`,
    report.timing.duration_s === null ? null : seconds(report.timing.duration_s),
    report.rate_hz === null ? "rate unknown" : `${number(report.rate_hz, 4)}\u00a0Hz`,
    report.episodes === 1 ? null : counted(report.episodes, "episode"),
    CONVENTIONS[dataset.torque_convention] ?? dataset.torque_convention,
    report.robot,
  ];
  return h(
    "details",
    { class: "about" },
    h("summary", {}, line.filter(Boolean).join(" · ")),
    facts([
      ["Rows uploaded", count(report.rows_uploaded)],
      ["Episodes", count(report.episodes)],
      ["Derived signals", report.derived.length ? report.derived.join(", ") : "none"],
      ["Robot", report.robot ?? "unspecified"],
      ["Uploaded", when(dataset.created_at)],
      ["ID", h("code", {}, dataset.id)],
    ]),
    h("p", {}, h("span", { class: "muted" }, "Joints: "), joints.join(", ")),
  );
}
