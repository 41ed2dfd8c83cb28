// What a data set's report says first: the recording in short, and what to do about it.

import { jointVar } from "../../colours.js";
import { h } from "../../dom.js";
import { count, counted, number, seconds, shortNames, when } from "../../format.js";
import { card, facts } from "../../ui.js";
import { prose, warned } from "./prose.js";

const CONVENTIONS = { gravity_included: "gravity included", gravity_compensated: "gravity compensated" };
const FIRST = 3; // pieces of advice that are seen at once

/** Warnings, and what to do about the recording, the most important first. */
export function toDo({ report, joint_names: joints }) {
  const [first, rest] = [report.advice.slice(0, FIRST), report.advice.slice(FIRST)];
  const list = (texts, start) => h("ol", { class: "advice", start: String(start) }, texts.map((text) => h("li", {}, concerned(text, joints))));
  const made = card(
    "What to do about it",
    first.length ? list(first, 1) : h("p", {}, "✓ Nothing: the recording is good to train on."),
    rest.length ? h("details", {}, h("summary", {}, `${rest.length} more, less important`), list(rest, FIRST + 1)) : null,
  );
  made.classList.add("todo");
  if (!first.length) made.classList.add("done");
  return [warned(report.warnings), made];
}

/** A sentence that begins with the joints it is about: these as marks in their colours. */
function concerned(text, joints) {
  const [, who, what] = /^([^:]+): (.*)$/s.exec(text) ?? [null, "", text];
  const named = who.split(/, | and /);
  if (!who || !named.every((each) => joints.includes(each))) return prose(text);
  const names = shortNames(joints);
  const all = named.length === joints.length && joints.length > 1;
  const marks = named.map((each) => h("span", { class: "joint", style: `--own: ${jointVar(joints.indexOf(each))}` }, names[joints.indexOf(each)]));
  return [h("span", { class: "who" }, all ? "All joints" : marks), " ", prose(what)];
}

/** The recording in short: one line, and the rest where asked for. */
export function about({ report, joint_names: joints, ...dataset }) {
  const line = [
    `${counted(report.rows, "sample")} of ${counted(joints.length, "joint")}`,
    report.timing.duration_s === null ? null : seconds(report.timing.duration_s),
    report.rate_hz === null ? "rate not known" : `${number(report.rate_hz, 4)}\u00a0Hz`,
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
      ["Derived, not recorded", report.derived.length ? report.derived.join(", ") : "nothing"],
      ["Robot", report.robot ?? "not said"],
      ["Uploaded", when(dataset.created_at)],
      ["Id", h("code", {}, dataset.id)],
    ]),
    h("p", {}, h("span", { class: "muted" }, "Joints: "), joints.join(", ")),
  );
}
