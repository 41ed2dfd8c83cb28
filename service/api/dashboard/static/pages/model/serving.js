// Moving what answers: always asked first, as robots may be listening.

import { confirm } from "../../ui.js";
import { mayAnswer } from "./promotion.js";

/** Ask whether a version, as the API shows it, shall answer; true where it shall. */
export function confirmServing(name, version, serving) {
  const { word, why } = mayAnswer(version);
  return confirm(
    `Serve version ${version.version} of ${name}${serving === null ? "" : ` instead of version ${serving}`}? It answers every query that names no version. You can undo this under “Versions”. Judged: ${word}. ${why}.`,
    `Serve version ${version.version}`,
    "primary",
  );
}
