// Payload of each stream, and external torque of each joint.

import { jointVar } from "../../colours.js";
import { Badge, Card, Table } from "../../components.js";
import { kilograms, moment, shortNames, torqueUnit } from "../../format.js";
import { html, useRef } from "../../preact.js";
import { Explanation } from "./explanation.js";
import { externalTorque } from "./scores.js";

const STATES = { none: ["no change", "plain"], payload: ["payload", "good"], contact: ["contact", "warn"], friction: ["friction changed", "warn"] };
const CHECK_S = 3; // the service compares a little less than that
const NO_SAFETY = "Not a safety function. ";
const THRESHOLD_STD = 1.96; // standard deviations of a measurement

/**
 * Return what is known about the payload of each stream at a time in s: {stream: {state, checkedUntil}}. before: the last result, or null.
 * A payload looks like a contact at first: if one begins, the service checks for CHECK_S whether it is a payload.
 */
export function track(before, payloads, at) {
  return Object.fromEntries((payloads ?? []).map(({ stream_id: stream, state, mass }) => {
    const last = before?.[stream], isNew = state === "contact" && last && last.state !== "contact";
    return [stream, { state, checkedUntil: mass !== null || state !== "contact" ? 0 : isNew ? at + CHECK_S : (last?.checkedUntil ?? 0) }];
  }));
}

/** Return the streams whose payload is being checked. */
export function useChecking(status) {
  const last = useRef({ at: null, known: null });
  if (status && status.at !== last.current.at) last.current = { at: status.at, known: track(last.current.known, status.payloads, status.at) };
  const { at, known } = last.current;
  return new Set(Object.keys(known ?? {}).filter((stream) => at < known[stream].checkedUntil));
}

/** The payload of each stream; nothing if the model has no arm or there are no rows. checking: streams whose payload is being checked. */
export function Payload({ payloads, checking }) {
  if (!payloads?.length) return null;
  const inContact = payloads.filter((each) => each.state === "contact" && !checking.has(each.stream_id)).map((each) => each.stream_id);
  const mass = (each) => (checking.has(each.stream_id) ? "checking payload" : kilograms(each.mass));
  const state = (each) => (checking.has(each.stream_id) ? null : html`<${State} of=${each} />`);
  const [only] = payloads;
  const columns = [
    { label: "Stream", cell: (each) => each.stream_id },
    { label: "Payload", cell: (each) => html`<strong>${mass(each)}</strong>` },
    { label: "State", cell: state },
  ];
  return html`<${Card} title="Payload" term="payload">
    ${inContact.length > 0 && html`<p><${Badge} state=${`contact on ${inContact.join(", ")}: no payload explains the torque`} kind="warn" /></p>`}
    ${payloads.length === 1 ? html`<p class="big">${mass(only)}</p><p class="row">${state(only)}</p>` : html`<${Table} columns=${columns} rows=${payloads} caption="Payload by stream" identity=${(each) => each.stream_id} />`}
    <${Explanation} first=${NO_SAFETY}>Mass at the tip, in addition to the mass during training; ± one standard deviation. Predictions include it. A payload looks like a contact at first, so it is checked for up to ${CHECK_S} s. If the arm was learnt without a URDF, the mass is only as accurate as the learnt lengths.<//>
  <//>`;
}

function State({ of: { state, declared, since } }) {
  const [word, kind] = STATES[state];
  return html`<${Badge} state=${word} kind=${kind} />${declared && " declared"} <span class="muted">${since !== null && `since ${moment(since)}`}</span>`;
}

/** A bar of the external torque for each joint; nothing without recent rows. */
export function External({ rows, joints, types }) {
  const found = externalTorque(rows, joints);
  if (!found.some(Boolean)) return null;
  const short = shortNames(joints);
  const most = Math.max(...found.map((each) => (each ? Math.max(Math.abs(each.mean), THRESHOLD_STD * each.std) : 0)));
  const far = found.flatMap((each, joint) => (each && Math.abs(each.mean) > THRESHOLD_STD * each.std ? [short[joint]] : []));
  return html`<${Card} title="External torque">
    <p><${Badge} state=${far.length ? `external torque on ${far.join(", ")}` : "no external torque"} kind=${far.length ? "warn" : "good"} /></p>
    <ul class="forces">${found.map((each, joint) => html`<li key=${joints[joint]}><span class="joint" style=${{ "--own": jointVar(joint) }}>${short[joint]}</span><${Force} found=${each} most=${most} unit=${torqueUnit(types[joint])} /></li>`)}</ul>
    <${Explanation} first=${NO_SAFETY}>Measured − predicted torque, mean of the last half second. The grey range is the 95 % interval of a single measurement without external torque; it is wide if the model is uncertain.<//>
  <//>`;
}

function Force({ found, most, unit }) {
  if (!found) return html`<span class="force"></span><span class="numeric">–</span>`;
  const [share, threshold] = [found.mean / most, (THRESHOLD_STD * found.std) / most].map((each) => 50 * each);
  const calm = { left: `${50 - threshold}%`, width: `${2 * threshold}%` };
  const bar = { left: `${50 + Math.min(share, 0)}%`, width: `${Math.abs(share)}%` };
  return html`<span class="force" aria-hidden="true"><i class="calm" style=${calm} /><i class=${Math.abs(share) > threshold ? "far" : ""} style=${bar} /></span>
    <span class="numeric">${found.mean < 0 ? "−" : "+"}${Math.abs(found.mean).toFixed(2)}\u00a0${unit}</span>`;
}
