// Choice of the part that is held out of the training to evaluate the version.

import { Choice, Field } from "../../components.js";
import { html } from "../../preact.js";

const KINDS = [
  ["auto", "automatic"],
  ["last", "the last part of each recording"],
  ["episodes", "whole episodes"],
  ["blocks", "random blocks"],
  ["", "nothing"],
];
const EXPLANATIONS = {
  auto: "The last part of each recording, or another part if the last one repeats earlier motion.",
  last: "This does not test other kinds of motion. To do so, evaluate the version on another recording.",
  episodes: "The seed selects the episodes. If every recording has one episode, whole recordings are held out.",
  blocks: "The seed selects the blocks. They resemble their neighbours, so the figures are better than on a new recording.",
  stretches: "The rows that you selected on the page of the recording. All other recordings are used for training.",
  "": "The quality of the version remains unknown. Choose this only if you evaluate it on another recording.",
};

/** The choice before any change; numbers are texts, as typed. */
export const NO_CHANGES = { kind: "auto", share: "30", blocks: "10", seed: "0", guard_s: "", only: false };

/** The fields. named: rows selected on the page of a data set, {data set: [[first, last]]}, or null. */
export function Holdout({ value, onchange, named }) {
  const set = (name, changed) => onchange({ ...value, [name]: changed });
  const kinds = named ? [["stretches", "the range selected in the plots"], ...KINDS] : KINDS;
  const number = (label, name, limits, hint) => html`<${Field} label=${label} hint=${hint} input=${(attributes) => html`<input ...${attributes}
    type="number" name=${`holdout.${name}`} value=${value[name]} onInput=${(event) => set(name, event.target.value)} ...${limits} />`} />`;
  const { kind } = value;
  return html`<fieldset>
    <legend>Hold out</legend>
    <p class="hint">The model is first trained without this part and evaluated on it. Then it is trained on all rows.</p>
    <${Choice} label="Which part" options=${kinds} value=${kind} onchange=${(changed) => set("kind", changed)} hint=${EXPLANATIONS[kind]} />
    ${kind && html`<div class="grid thirds">
      ${kind !== "stretches" && number("Share, %", "share", { min: 1, max: 90, step: "any", required: true })}
      ${kind === "blocks" && number("Blocks", "blocks", { min: 2, max: 1000, step: 1, required: true })}
      ${(kind === "blocks" || kind === "episodes") && number("Seed", "seed", { min: 0, max: 2147483647, step: 1, required: true })}
      ${number("Guard, s", "guard_s", { min: 0, max: 3600, step: "any", placeholder: "one filter period" }, "Samples this close to the boundary are in neither part.")}
    </div>
    <${Field} kind="check" label="Never train on this part" input=${(attributes) => html`<input ...${attributes} type="checkbox" name="holdout.only" checked=${value.only} onChange=${(event) => set("only", event.target.checked)} />`} />`}
  </fieldset>`;
}

/** Return the holdout of a job request; null for nothing. */
export function holdoutOf({ kind, share, blocks, seed, guard_s: guard, only }, named) {
  if (!kind) return null;
  const chosen = { kind, ...(kind === "stretches" ? { stretches: named } : { share: Number(share) / 100 }) };
  if (only) chosen.only = true;
  if (kind === "blocks") chosen.blocks = Number(blocks);
  if (kind !== "last" && kind !== "stretches") chosen.seed = Number(seed);
  return guard ? { ...chosen, guard_s: Number(guard) } : chosen;
}
