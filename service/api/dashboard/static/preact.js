// Preact with htm: components, hooks, and templates that the browser reads without a build step.

import { h, render } from "/dashboard/libraries/preact-11.2.0.js";
import htm from "/dashboard/libraries/htm-3.1.1.js";

export { render };
export { useCallback, useEffect, useMemo, useRef, useState } from "/dashboard/libraries/preact-hooks-11.2.0.js";

/** A template of elements and components: html`<${Card} title="Data"><p class="hint">${text}</p><//>`. */
export const html = htm.bind(h);
