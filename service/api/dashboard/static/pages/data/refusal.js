// A refused upload: what is wrong where, what was expected, and what to do about it.

import { ApiError } from "../../api.js";
import { h } from "../../dom.js";
import { button, table } from "../../ui.js";

const ADVICE = {
  unreachable: "The recording may have been stored. Look at the list before you try again.",
  unsupported_media_type: "Give the file the ending of its format, or export it in one of these formats.",
  too_large: "Split the recording, or lower its rate. The service takes no larger files.",
  storage_full: "Delete data sets or model versions that are no longer needed, then try again.",
  storage_unavailable: "Nothing was stored. Try again in a moment.",
  busy: "The service is busy. Try again in a moment.",
  rate_limited: "Too many requests. Try again in a moment.",
  forbidden: "The API key may not upload data. Use one with the scope train.",
};

/**
 * The refusal of a file as an alert.
 * accept(option, value): uploads it again as the service proposes, for this file only; again(): with the options as set.
 */
export function refusal(name, error, accept, again) {
  const detail = error instanceof ApiError ? (error.detail ?? []) : [];
  const known = detail.length > 0;
  const offers = detail.flatMap((each) => suggestions(each.expected)).map((each) =>
    button(`Set ${each.said} and try again`, () => accept(each.option, each.value)),
  );
  const advice = ADVICE[error.code] ?? (known ? "Correct the file, or say how to read it under “How to read it”." : "");
  return h(
    "div",
    { class: "error", role: "alert" },
    h("p", {}, h("strong", {}, error.status === 0 ? `${name}: no answer. ` : `${name} was not taken. `), known ? "Nothing was stored." : error.message),
    known ? problems(detail) : "",
    advice ? h("p", {}, advice) : "",
    h("div", { class: "actions" }, ...offers, button("Try again", again)),
  );
}

function problems(detail) {
  return table(
    [
      { label: "Where", cell: (row) => h("code", {}, row.field) },
      { label: "Found", cell: (row) => row.value ?? "–" },
      { label: "Expected", cell: (row) => row.expected },
    ],
    detail,
    { caption: "What is wrong" },
  );
}

/** What the service proposes in its messages, as {option, value, said}: units={"q": "deg"}, drop_joints=gripper. */
export function suggestions(text) {
  const found = [];
  for (const [, option, json] of text.matchAll(/\b(units|columns)=(\{[^{}]*\})/g)) {
    let value;
    try {
      value = JSON.parse(json);
    } catch {
      continue;
    }
    const said = Object.entries(value).map(([name, what]) => `${name} to ${what}`).join(", ");
    // the service writes … where only the user can know
    if (!json.includes("…")) found.push({ option, value, said: `the ${option === "units" ? "unit" : "column"} of ${said}` });
  }
  for (const [, joint] of text.matchAll(/\bdrop_joints=([^\s,;]+)/g)) {
    found.push({ option: "drop_joints", value: joint, said: `“leave out ${joint}”` });
  }
  return found;
}
