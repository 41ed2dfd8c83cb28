// Let a version serve, after a confirmation: connected robots are affected.

import { put } from "../../api.js";
import { confirm } from "../../dialogs.js";

/** Return label and kind of the button that lets a version serve. */
export function servingButton({ version, verdict }) {
  return verdict.serves ? [`Serve version ${version}`, "primary"] : [`Serve version ${version} anyway`, "danger"];
}

/** Ask whether an alias should point to a version, and move it; return whether it moved. */
export async function moveAlias({ name, where, model }, alias, chosen) {
  const { version, verdict } = chosen, serving = model.serving_version;
  const what = alias === "serving"
    ? `Serve version ${version} of ${name}${serving === null ? "" : ` instead of version ${serving}`}? It will answer every query that names no version. To undo this, roll back the alias “serving”.`
    : `Point the alias “${alias}” to version ${version} of ${name}?`;
  const question = `${what} Verdict: ${verdict.label}. ${verdict.reason}`;
  const [label, kind] = alias === "serving" ? servingButton(chosen) : ["Set alias", verdict.serves ? "primary" : "danger"];
  if ((alias === "serving" || !verdict.serves) && !(await confirm(question, label, kind))) return false;
  await put(`${where}/aliases/${encodeURIComponent(alias)}`, { version, override: !verdict.serves });
  return true;
}
