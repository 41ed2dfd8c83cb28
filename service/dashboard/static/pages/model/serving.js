// Moving what answers: always asked first, as robots may be listening.

import { confirm } from "../../ui.js";

/** Ask whether a version shall answer; true where it shall. */
export function confirmServing(name, version, serving) {
  return confirm(
    `Serve version ${version} of ${name} instead of version ${serving}? It will answer every query and stream that names no version, from the next one on. You can undo this under “Versions”.`,
    `Serve version ${version}`,
    "primary",
  );
}
