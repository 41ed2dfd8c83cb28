// Controls of the live plots: time window, and a cursor for the keyboard.

import { Choice } from "../../components.js";
import { html } from "../../preact.js";
import { WINDOWS_S } from "./rows.js";

/** The controls. point(x): called when the cursor moves, null if it is removed. */
export function Toolbar({ view, setView, cursor, point }) {
  const windows = WINDOWS_S.map((each) => [String(each), each < 60 ? `${each} s` : `${each / 60} min`]);
  const at = cursor === null ? "now" : `${cursor.toFixed(1)} s`;
  return html`<div class="grid thirds">
    <${Choice} label="Time window" options=${windows} value=${String(view.window)} onchange=${(value) => setView({ window: Number(value) })} />
    <div class="field">
      <span class="row" aria-hidden="true"><b>Cursor</b><output class="muted">${at}</output></span>
      <input type="range" min=${-view.window} max="0" step="any" value=${cursor ?? 0} aria-label="Cursor, seconds before the newest row" aria-valuetext=${at} onInput=${(event) => point(event.target.valueAsNumber || null)} />
    </div>
  </div>`;
}
