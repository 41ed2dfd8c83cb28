// Notes on samples that the version was trained on: their figures are optimistic.

import { html } from "../../preact.js";
import { HELD_OUT_NOTE } from "../job/words.js";

/** Notes for a trace; none if its samples are new to the version. */
export function TrainingDataNotes({ trace: { version, revision, in_training: trained, part } }) {
  if (part === "held_out") {
    return html`<p class="hint">${trained ? `${HELD_OUT_NOTE} The figures are those of the evaluation. The torque plots are of version ${version}, which was trained on these rows.` : `These samples were held out of the training of version ${version}.`}</p>`;
  }
  return html`
    ${trained && html`<p class="banner" role="note"><strong>Optimistic figures.</strong> Version ${version} was trained on some or all of these samples. Select a recording that it was not trained on.</p>`}
    ${revision > 0 && html`<p class="banner" role="note">Version ${version} has learnt online since its training (revision ${revision}). If it learnt from this recording, figures and plots are optimistic.</p>`}`;
}
