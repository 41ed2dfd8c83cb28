// Payload of each stream, and external torque of each joint.

import { jointVar } from "../../colours.js";
import { h } from "../../dom.js";
import { kilograms, moment, shortNames, torqueUnit } from "../../format.js";
import { badge, card, explanation, table } from "../../ui.js";
import { externalTorque } from "./scores.js";

const STATES = { none: ["no change", "plain"], payload: ["payload", "good"], contact: ["contact", "warn"], friction: ["friction changed", "warn"] };
const NO_SAFETY = "Not a safety function. ";
const THRESHOLD_STD = 1.96; // standard deviations of a measurement

/** Return a card with the payload of each stream; null if the model has no arm or there are no rows. */
export function payloadCard({ payloads }) {
  if (!payloads?.length) return null;
  const inContact = payloads.filter((each) => each.state === "contact").map((each) => each.stream_id);
  const state = (each) => [badge(...STATES[each.state]), each.declared ? " declared" : null];
  const since = (each) => (each.since === null ? null : `since ${moment(each.since)}`);
  const [only] = payloads;
  return card(
    "Payload",
    inContact.length ? h("p", {}, badge(`contact on ${inContact.join(", ")}: no payload explains the torque`, "warn")) : null,
    payloads.length === 1
      ? [h("p", { class: "big" }, kilograms(only.mass)), h("p", { class: "row" }, state(only), h("span", { class: "muted" }, since(only)))]
      : table(
          [
            { label: "Stream", cell: (each) => each.stream_id },
            { label: "Payload", cell: (each) => h("strong", {}, kilograms(each.mass)) },
            { label: "State", cell: (each) => [state(each), " ", h("span", { class: "muted" }, since(each))] },
          ],
          payloads,
          { caption: "Payload by stream", key: (each) => each.stream_id },
        ),
    explanation("Mass at the tip, in addition to the mass during training; ± one standard deviation. Predictions include it. If the arm was learnt without a URDF, the mass is only as accurate as the learnt lengths.", NO_SAFETY),
  );
}

/** Return a card with a bar of the external torque for each joint; null if there are no recent rows. */
export function externalCard(rows, joints, types) {
  const found = externalTorque(rows, joints);
  if (!found.some(Boolean)) return null;
  const short = shortNames(joints);
  const most = Math.max(...found.map((each) => (each ? Math.max(Math.abs(each.mean), THRESHOLD_STD * each.std) : 0)));
  const far = found.flatMap((each, joint) => (each && Math.abs(each.mean) > THRESHOLD_STD * each.std ? [short[joint]] : []));
  return card(
    "External torque",
    h("p", {}, far.length ? badge(`external torque on ${far.join(", ")}`, "warn") : badge("no external torque", "good")),
    h("ul", { class: "forces" }, found.map((each, joint) => h("li", { "data-key": joints[joint] }, h("span", { class: "joint", style: `--own: ${jointVar(joint)}` }, short[joint]), torqueBar(each, most, torqueUnit(types[joint]))))),
    explanation("Measured − predicted torque, mean of the last half second. The grey range is the 95 % interval of a single measurement without external torque; it is wide if the model is uncertain.", NO_SAFETY),
  );
}

function torqueBar(found, most, unit) {
  if (!found) return [h("span", { class: "force" }), h("span", { class: "numeric" }, "–")];
  const [share, threshold] = [found.mean / most, (THRESHOLD_STD * found.std) / most].map((each) => 50 * each);
  const far = Math.abs(share) > threshold;
  const [left, width] = [50 + Math.min(share, 0), Math.abs(share)];
  return [
    h("span", { class: "force", "aria-hidden": "true" }, h("i", { class: "calm", style: `left: ${50 - threshold}%; width: ${2 * threshold}%` }), h("i", { class: far ? "far" : "", style: `left: ${left}%; width: ${width}%` })),
    h("span", { class: "numeric" }, `${found.mean < 0 ? "−" : "+"}${Math.abs(found.mean).toFixed(2)}\u00a0${unit}`),
  ];
}
