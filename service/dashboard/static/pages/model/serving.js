// Moving what answers: always asked first, as robots may be listening.

import { confirm } from "../../ui.js";

/** Ask whether a version shall answer; true where it shall. */
export function confirmServing(name, version, serving) {
  return confirm(
    `Let version ${version} of ${name} answer instead of version ${serving}? Every query and stream that names no version is answered by it from the next one on. The step can be taken back under “Versions”.`,
    `Serve version ${version}`,
    "primary",
  );
}
