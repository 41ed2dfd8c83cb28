// Error of an upload: its cause and what to do.

import { ApiError } from "../../api.js";
import { h } from "../../dom.js";
import { sentence } from "../../format.js";
import { button, table } from "../../ui.js";

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

/**
 * Return an alert for a file that could not be imported.
 * accept(option, value): upload this file again with a proposed option; again(): upload it with the same options.
 */
export function uploadError(name, error, accept, again) {
  const detail = error instanceof ApiError ? (error.detail ?? []) : [];
  const known = detail.length > 0;
  const offers = detail.flatMap((each) => suggestions(each.expected)).map((each) =>
    button(`Set ${each.label} and retry`, () => accept(each.option, each.value)),
  );
  const advice = ADVICE[error.code] ?? (known ? "Correct the file, or set the import options below." : "");
  return h(
    "div",
    { class: "error", role: "alert" },
    h("p", {}, h("strong", {}, error.status === 0 ? `${name}: no connection. ` : `${name} could not be imported. `), known ? "Nothing was stored. " : "", sentence(error.message)),
    detail.length > 1 ? problems(detail) : "",
    advice ? h("p", {}, advice) : "",
    h("div", { class: "actions" }, ...offers, button("Retry", again)),
  );
}

function problems(detail) {
  return table(
    [
      { label: "Field", cell: (row) => h("code", {}, row.field) },
      { label: "Found", cell: (row) => row.value ?? "–" },
      { label: "Expected", cell: (row) => row.expected },
    ],
    detail,
    { caption: "Details" },
  );
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
