// The API key: requested when the service requires one, kept until the tab is closed, sent with every request.

import { ask } from "./dialogs.js";
import { html } from "./preact.js";

const STORAGE_KEY = "lipserve-key";
let pending = null;

/** Return the current key; null if there is none. */
export function key() {
  return sessionStorage.getItem(STORAGE_KEY);
}

/** Ask for a key and return whether one was entered. Requests that fail meanwhile wait for the same dialog. */
export function askForKey(reason) {
  pending ??= dialog(reason).finally(() => {
    pending = null;
  });
  return pending;
}

/** Forget the key. */
export function forgetKey() {
  sessionStorage.removeItem(STORAGE_KEY);
}

async function dialog(reason) {
  let given = "";
  const form = html`<form method="dialog">
    <h2 id="key-title">API key</h2>
    <p id="key-reason">${reason || "This service requires an API key."}</p>
    <div class="field"><label for="key-input">Key</label><input id="key-input" type="password" autocomplete="off" spellcheck=${false} required placeholder="lip_…" aria-describedby="key-reason" data-first /></div>
    <p class="hint">Create one on the service's machine: <code>lipserve keys create --name me --scope admin</code></p>
    <p class="hint">The key is kept until you close this tab.</p>
    <div class="actions"><button class="primary" value="use">Use key</button><button value="cancel" formnovalidate>Cancel</button></div>
  </form>`;
  const value = await ask(form, { "aria-labelledby": "key-title" }, (box) => (given = box.querySelector("input").value.trim()));
  if (value === "use" && given) sessionStorage.setItem(STORAGE_KEY, given);
  document.dispatchEvent(new Event("keychange"));
  return value === "use" && given !== "";
}
