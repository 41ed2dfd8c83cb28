// What the arm of each stream carries, and the torque from outside on each joint, as far as its rows tell.

import { jointVar } from "../../colours.js";
import { h } from "../../dom.js";
import { count, shortNames, torqueUnit, when } from "../../format.js";
import { badge, card, table } from "../../ui.js";
import { unexplained } from "./scores.js";

const STATES = { none: ["nothing new", "plain"], payload: ["payload", "good"], contact: ["contact", "warn"], friction: ["friction has changed", "warn"] };
const FAR = 1.96; // standard deviations of a measurement, beyond which a mean of many is no noise

/** Mass, state and since when, stream by stream; nothing where the model knows no arm, or no stream has told anything. */
export function carriedCard({ payloads }) {
  if (!payloads?.length) return null;
  const touched = payloads.filter((each) => each.state === "contact").map((each) => each.stream_id);
  return card(
    "Payload",
    touched.length ? h("p", {}, badge(`a contact is seen on ${touched.join(", ")}: torques that no payload explains`, "warn")) : null,
    payloads.length === 1 ? h("p", { class: "big" }, kilograms(payloads[0].mass)) : null,
    table(
      [
        { label: "Stream", cell: (each) => each.stream_id },
        { label: "Carries", cell: (each) => h("strong", {}, kilograms(each.mass)) },
        { label: "State", cell: (each) => [badge(...STATES[each.state]), each.declared ? " declared" : null] },
        { label: "Since", cell: (each) => (each.since === null ? "–" : when(each.since)) },
        { label: "Rows", numeric: true, cell: (each) => count(each.rows) },
      ],
      payloads,
      { caption: "What the arm carries beyond what it was trained with, ± one standard deviation", key: (each) => each.stream_id },
    ),
    h("p", { class: "hint" }, "Answers contain it. Where the arm was learnt from torque alone, kilograms are as good as its lengths. No safety function."),
  );
}

/** Bars of the torque that the model does not explain, joint by joint; nothing where nothing was measured of late. */
export function externalCard(rows, joints, types) {
  const found = unexplained(rows, joints);
  if (!found.some(Boolean)) return null;
  const short = shortNames(joints);
  const most = Math.max(...found.map((each) => (each ? Math.max(Math.abs(each.mean), FAR * each.std) : 0)));
  const far = found.flatMap((each, joint) => (each && Math.abs(each.mean) > FAR * each.std ? [short[joint]] : []));
  return card(
    "External torque",
    h("p", {}, far.length ? badge(`something acts on ${far.join(", ")}`, "warn") : badge("nothing beyond what the model is unsure of", "good")),
    h("ul", { class: "forces" }, found.map((each, joint) => h("li", { "data-key": joints[joint] }, h("span", { class: "joint", style: `--own: ${jointVar(joint)}` }, short[joint]), force(each, most, torqueUnit(types[joint]))))),
    h("p", { class: "hint" }, "Measured − predicted, mean of the last half second. The grey range holds 95 % of single measurements where nothing acts; it is wide where the model is unsure. No safety function."),
  );
}

function force(found, most, unit) {
  if (!found) return [h("span", { class: "force" }), h("span", { class: "numeric" }, "–")];
  const [share, calm] = [found.mean / most, (FAR * found.std) / most].map((each) => 50 * each);
  const far = Math.abs(share) > calm;
  const [left, width] = [50 + Math.min(share, 0), Math.abs(share)];
  return [
    h("span", { class: "force", "aria-hidden": "true" }, h("i", { class: "calm", style: `left: ${50 - calm}%; width: ${2 * calm}%` }), h("i", { class: far ? "far" : "", style: `left: ${left}%; width: ${width}%` })),
    h("span", { class: "numeric" }, `${found.mean < 0 ? "−" : "+"}${Math.abs(found.mean).toFixed(2)}\u00a0${unit}`),
  ];
}

/** 1.48 ± 0.03 kg. */
function kilograms(mass) {
  return mass === null ? "nothing" : `${mass.mean.toFixed(2)} ± ${mass.std.toFixed(2)}\u00a0kg`;
}
