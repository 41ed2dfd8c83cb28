// Warnings of the service as chips that open their text.

import { html } from "./preact.js";
import { Prose } from "./prose.js";

/** Chips with the first clause of each warning; a chip opens its whole text. */
export function Warnings({ texts }) {
  if (!texts.length) return null;
  return html`<section class="chips" aria-label="Warnings">
    ${texts.map((text) => {
      const first = /^.*?(?=[.;:,](\s|$)|\s\()/.exec(text)?.[0] ?? text;
      return html`<details key=${text}><summary><span class="badge warn">! <${Prose} text=${first} /></span></summary><p><${Prose} text=${text} /></p></details>`;
    })}
  </section>`;
}
