// Confirmation before another version serves: connected robots are affected.

import { confirm } from "../../ui.js";
import { promotionCheck } from "./promotion.js";

/** Ask whether a version should serve; return the decision. */
export function confirmServing(name, version, serving) {
  const { word, why } = promotionCheck(version);
  return confirm(
    `Serve version ${version.version} of ${name}${serving === null ? "" : ` instead of version ${serving}`}? It will answer every query that names no version. To undo this, roll back the alias “serving”. Held-out check: ${word}. ${why}`,
    `Serve version ${version.version}`,
    "primary",
  );
}
