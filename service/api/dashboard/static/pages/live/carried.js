// What the arm of each stream carries, and the torque from outside on each joint, as far as its rows tell.

import { jointVar } from "../../colours.js";
import { h } from "../../dom.js";
import { kilograms, moment, shortNames, torqueUnit } from "../../format.js";
import { badge, card, explained, table } from "../../ui.js";
import { unexplained } from "./scores.js";

const STATES = { none: ["nothing new", "plain"], payload: ["payload", "good"], contact: ["contact", "warn"], friction: ["friction has changed", "warn"] };
const NO_SAFETY = "No safety function. ";
const FAR = 1.96; // standard deviations of a measurement, beyond which a mean of many is no noise

/** Mass, state and since when, stream by stream; nothing where the model knows no arm, or no stream has told anything. */
export function carriedCard({ payloads }) {
  if (!payloads?.length) return null;
  const touched = payloads.filter((each) => each.state === "contact").map((each) => each.stream_id);
  const state = (each) => [badge(...STATES[each.state]), each.declared ? " declared" : null];
  const since = (each) => (each.since === null ? null : `since ${moment(each.since)}`);
  const [only] = payloads;
  return card(
    "Payload",
    touched.length ? h("p", {}, badge(`a contact is seen on ${touched.join(", ")}: torques that no payload explains`, "warn")) : null,
    payloads.length === 1
      ? [h("p", { class: "big" }, kilograms(only.mass)), h("p", { class: "row" }, state(only), h("span", { class: "muted" }, since(only)))]
      : table(
          [
            { label: "Stream", cell: (each) => each.stream_id },
            { label: "Carries", cell: (each) => h("strong", {}, kilograms(each.mass)) },
            { label: "State", cell: (each) => [state(each), " ", h("span", { class: "muted" }, since(each))] },
          ],
          payloads,
          { caption: "Streams and what their arms carry", key: (each) => each.stream_id },
        ),
    explained("What the arm carries beyond what it was trained with, ± one standard deviation. Answers contain it. Where the arm was learnt from torque alone, kilograms are as good as its lengths.", NO_SAFETY),
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
    h("p", {}, far.length ? badge(`something acts on ${far.join(", ")}`, "warn") : badge("no torque from outside", "good")),
    h("ul", { class: "forces" }, found.map((each, joint) => h("li", { "data-key": joints[joint] }, h("span", { class: "joint", style: `--own: ${jointVar(joint)}` }, short[joint]), force(each, most, torqueUnit(types[joint]))))),
    explained("Measured − predicted, mean of the last half second. The grey range holds 95 % of single measurements where nothing acts; it is wide where the model is unsure.", NO_SAFETY),
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
