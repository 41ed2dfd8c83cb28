// Optional extras of the service: what is missing and how to install it.

import { get } from "./api.js";
import { html, useEffect, useState } from "./preact.js";

let pending = null;

/** Read `/health` once: extras do not change while the service runs. */
function readHealth() {
  pending ??= get("/health").catch((error) => {
    pending = null;
    throw error;
  });
  return pending;
}

/** Return an extra {gives, install} if the service lacks it; null if it has it, or before this is known. */
export function useMissing(extra) {
  const [missing, setMissing] = useState(null);
  useEffect(() => {
    // other parts of the page report that the service does not answer
    readHealth().then((health) => setMissing(health.missing.find((each) => each.extra === extra) ?? null), () => {});
  }, [extra]);
  return missing;
}

/** A hint how to install an extra, from `useMissing`. */
export function MissingExtra({ missing }) {
  return missing && html`<p class="hint">To ${missing.gives}, install on the service's machine: <code>${missing.install}</code></p>`;
}
