// What the service can do: which extras are installed where it runs.

import { get } from "./api.js";
import { h, replace } from "./dom.js";

let asked = null;

/** What the service says of itself; asked for once, as it does not change while it runs. */
export function abilities() {
  asked ??= get("/health").catch((error) => {
    asked = null;
    throw error;
  });
  return asked;
}

/** What an extra is for and how it is installed, where it is missing, as a hint; then the controls are disabled. */
export function lacking(extra, ...controls) {
  const place = h("p", { class: "hint", hidden: true });
  const say = ({ missing }) => {
    const found = missing.find((each) => each.extra === extra);
    if (!found) return;
    place.hidden = false;
    for (const control of controls) control.disabled = true;
    replace(place, `To ${found.gives}, install where the service runs: `, h("code", {}, found.install));
  };
  abilities().then(say, () => {}); // a service that does not answer is told of elsewhere
  return place;
}
