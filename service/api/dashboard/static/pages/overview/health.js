// Health of the service in one line, and its failed checks. /health/ready needs no key.

import { get } from "../../api.js";
import { Badge, useRead } from "../../components.js";
import { when } from "../../format.js";
import { html } from "../../preact.js";

/** The health, read again after each `period` in seconds. */
export function Health({ period }) {
  const { value, error, at } = useRead(read, [], period);
  const [word, kind] = error ? ["no connection", "bad"] : stateOf(value);
  const checks = error ? [{ name: "service", state: "failed", message: error.message }] : (value?.checks ?? []);
  const wrong = checks.filter((each) => each.state !== "ok");
  return html`<section class="health" aria-labelledby="health">
    <div class="row">
      <h2 id="health">Health</h2> <span role="status"><${Badge} state=${word} kind=${kind} /></span>
      ${value?.version && html`<span class="muted">LIPServe ${value.version}</span>`}
      ${error && at && html`<span class="hint">last response ${when(at / 1000)}</span>`}
    </div>
    ${wrong.length > 0 && html`<${Checks} checks=${wrong} />`}
    <details><summary>All checks</summary><${Checks} checks=${checks} /></details>
  </section>`;
}

/** Return the answer of the service; also if it is not ready. */
async function read(signal) {
  try {
    return await get("/health/ready", {}, signal);
  } catch (error) {
    if (error.status !== 503 || !error.detail?.length) throw error;
    return { failed: true, checks: error.detail.map((item) => ({ name: item.field, state: "failed", message: item.value })) };
  }
}

function stateOf(value) {
  if (!value) return ["checking", "plain"];
  if (value.failed) return ["not ready", "bad"];
  return value.checks.every((each) => each.state === "ok") ? ["ready", "good"] : ["ready, with warnings", "warn"];
}

function Checks({ checks }) {
  return html`<ul class="parts">${checks.map(({ name, state, message }) => html`<li key=${name}><${Badge} state=${state} /> <strong>${name}</strong> <span class="muted">${String(message)}</span></li>`)}</ul>`;
}
