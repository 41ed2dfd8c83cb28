// Error of an upload: its cause and what to do.

import { ApiError } from "../../api.js";
import { Button, Table } from "../../components.js";
import { sentence } from "../../format.js";
import { html } from "../../preact.js";

const ADVICE = {
  unreachable: "The recording may have been stored. Check the list before you retry.",
  unsupported_media_type: "Use the file extension of its format, or export the recording in one of these formats.",
  too_large: "Split the recording or lower its rate.",
  storage_full: "Delete data sets or model versions that you no longer need, then retry.",
  storage_unavailable: "Nothing was stored. Retry in a moment.",
  busy: "The service is busy. Retry in a moment.",
  rate_limited: "Too many requests. Retry in a moment.",
  forbidden: "This API key may not upload data. Use a key with the scope train.",
};
const COLUMNS = [
  { label: "Field", cell: (row) => html`<code>${row.field}</code>` },
  { label: "Found", cell: (row) => (typeof row.value === "object" ? JSON.stringify(row.value) : row.value ?? "–") },
  { label: "Expected", cell: (row) => row.expected },
];

/** An alert for a file that could not be imported. accept(option, value): import it with a proposed option; again(): with the same options. */
export function UploadError({ name, error, accept, again }) {
  const detail = error instanceof ApiError ? (error.detail ?? []) : [];
  const advice = ADVICE[error.code] ?? (detail.length ? "Correct the file, or set the import options." : "");
  const offers = detail.flatMap((each) => suggestions(each.expected));
  return html`<div class="error" role="alert">
    <p><strong>${error.status === 0 ? `${name}: no connection.` : `${name} could not be imported.`}</strong> ${detail.length > 0 && "Nothing was stored. "}${sentence(error.message)}</p>
    ${detail.length > 1 && html`<${Table} columns=${COLUMNS} rows=${detail} caption="Details" />`}
    ${advice && html`<p>${advice}</p>`}
    <div class="actions">
      ${offers.map((each) => html`<${Button} key=${each.label} onclick=${() => accept(each.option, each.value)}>Set ${each.label} and retry<//>`)}
      <${Button} key="again" onclick=${again}>Retry<//>
    </div>
  </div>`;
}

/** Find the options that a message proposes, as {option, value, label}: units={"q": "deg"}, drop_joints=gripper. */
export function suggestions(text) {
  const found = [];
  for (const [, option, json] of text.matchAll(/\b(units|columns)=(\{[^{}]*\})/g)) {
    let value;
    try {
      value = JSON.parse(json);
    } catch {
      continue;
    }
    const columns = Object.entries(value).map(([name, what]) => `${name} to ${what}`).join(", ");
    // … stands for a value that only the user knows
    if (!json.includes("…")) found.push({ option, value, label: `the ${option === "units" ? "unit" : "column"} of ${columns}` });
  }
  for (const [, joint] of text.matchAll(/\bdrop_joints=([^\s,;]+)/g)) {
    found.push({ option: "drop_joints", value: joint, label: `“drop ${joint}”` });
  }
  return found;
}
