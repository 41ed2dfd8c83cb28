// Let a version serve, after a confirmation: connected robots are affected.

import { post, put } from "../../api.js";
import { confirm } from "../../dialogs.js";
import { when } from "../../format.js";

const SAME_TIME_MS = 1000; // a version and the move by which it serves at once are stored together

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

/** Ask whether an alias should point to its previous version again, and move it; return a notice, or nothing if it stays. */
export async function rollBack({ name, where }, { alias, version, previous }) {
  const what = alias === "serving" ? `Version ${previous} of ${name} will serve instead of version ${version}.` : `It will point to version ${previous} again.`;
  if (!(await confirm(`Roll back the alias “${alias}”? ${what}`, `Roll back to version ${previous}`, "primary"))) return "";
  const now = await post(`${where}/aliases/${encodeURIComponent(alias)}/rollback`, {});
  return `${alias} → version ${now.version}`;
}

/** Return why the serving version serves. serving: the alias. */
export function servingReason({ version, history: [move] }, versions) {
  const { created_at: created, promotion, verdict } = versions.find((each) => each.version === version);
  const isAutomatic = promotion?.answers && Date.parse(move.at) - Date.parse(created) < SAME_TIME_MS;
  const serves = `Version ${version} is serving`;
  if (move.rollback) return `${serves}: rolled back from version ${move.before}, ${when(move.at)}.`;
  if (move.before === null) return `${serves}: no version served before.`;
  if (isAutomatic) return `${serves}. ${promotion.reason.replace(verdict.reason, "").trim()}`;
  return `${serves}: promoted instead of version ${move.before}, ${when(move.at)}.`;
}
