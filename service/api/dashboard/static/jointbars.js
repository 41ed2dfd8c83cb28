// Joints in their colours: names, keys of plots, bars.

import { jointVar } from "./colours.js";
import { html } from "./preact.js";

/** The name of a joint beside its colour; a long name breaks after an underscore. index: its place in the data. */
export function Joint({ index, name }) {
  const parts = name.split(/(?<=_)/);
  return html`<span class="joint" style=${`--own: ${jointVar(index)}`}><span>${parts.map((part, at) => (at ? [html`<wbr />`, part] : part))}</span></span>`;
}

/** The key of a plot with the colours of all joints. */
export function JointKey({ names }) {
  return html`<p class="key" aria-hidden="true">${names.map((name, index) => html`<${Joint} index=${index} name=${name} />`)}</p>`;
}

/** A column for each joint. spans: [bottom, top] as shares of the height, null for an unknown value; texts: of the values. */
export function JointColumns({ names, spans, texts, what, nominal = null }) {
  const label = `${what} by joint: ${names.map((name, joint) => `${name} ${texts[joint]}`).join(", ")}`;
  const column = (span, joint) => html`<span title=${`${names[joint]}: ${texts[joint]}`}>${span && html`<b style=${`bottom: ${100 * span[0]}%; height: ${100 * (span[1] - span[0])}%; background: ${jointVar(joint)}`}></b>`}</span>`;
  return html`<div class="bars" role="img" aria-label=${label}>
    ${nominal !== null && html`<i class="rule nominal" style=${`bottom: ${100 * nominal}%`}></i>`}${spans.map(column)}
  </div>`;
}
