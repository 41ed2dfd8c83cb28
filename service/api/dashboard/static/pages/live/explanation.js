// An explanation that the reader can open.

import { html } from "../../preact.js";

/** The children, shown on demand; first: text that is always visible. */
export function Explanation({ first = "", children }) {
  return html`<details class="hint"><summary>${first}How to read this</summary><p>${children}</p></details>`;
}
