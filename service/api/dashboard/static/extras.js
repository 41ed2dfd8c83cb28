// Optional extras of the service: what is missing and how to install it.

import { get } from "./api.js";
import { h, replace } from "./dom.js";

let pending = null;

/** Read `/health` once: extras do not change while the service runs. */
function readHealth() {
  pending ??= get("/health").catch((error) => {
    pending = null;
    throw error;
  });
  return pending;
}

/** Return a hint that is shown only if an extra is missing; the controls that need it are then disabled. */
export function missingExtraHint(extra, ...controls) {
  const hint = h("p", { class: "hint", hidden: true });
  const show = ({ missing }) => {
    const found = missing.find((each) => each.extra === extra);
    if (!found) return;
    hint.hidden = false;
    for (const control of controls) control.disabled = true;
    replace(hint, `To ${found.gives}, install on the service's machine: `, h("code", {}, found.install));
  };
  readHealth().then(show, () => {}); // other parts of the page report that the service does not answer
  return hint;
}
