// Reading the file of a data set again with other options.

import { path, post } from "../../api.js";
import { Button, Card, useRead } from "../../components.js";
import { html, useState } from "../../preact.js";
import { notice } from "../../dialogs.js";
import { describeOptions } from "./findings.js";
import { ImportOptions, queryOf, valueOf, withOption } from "./options.js";
import { readRobots } from "./robot_choice.js";
import { UploadError } from "./upload_error.js";

/** Read the file of a data set again: {read(query), outcome}; outcome: what to show of the attempt. */
export function useReading(dataset) {
  const [outcome, setOutcome] = useState(null);
  const read = async (query) => {
    setOutcome(html`<p role="status">Reading ${dataset.name}…</p>`);
    try {
      const made = await post(`${path`/v1/datasets/${dataset.id}/read`}?${new URLSearchParams({ ...query, fresh: "true" })}`);
      notice(`${dataset.name} read again.`);
      location.hash = `#/data/${made.id}`;
    } catch (error) {
      setOutcome(html`<${UploadError} name=${dataset.name} error=${error} accept=${(option, value) => read(withOption(query, option, value))} again=${() => read(query)} />`);
    }
  };
  return { read, outcome };
}

/** Buttons that read the file again with the options that correct a fault. */
export function Corrections({ dataset: { report }, again: { read, outcome } }) {
  const remedies = report.remedies.filter((each) => each.options);
  return html`${remedies.length > 0 && html`<div class="actions corrections">${remedies.map((each) => html`<${Button} key=${each.cause} onclick=${() => read({ ...report.upload_options, ...each.options })}>Read again with ${describeOptions(each.options)}<//>`)}</div>`}
    ${outcome}`;
}

/** All options, filled with those of the last reading. */
export function ReadAgain({ dataset, again: { read } }) {
  const [value, setValue] = useState(() => valueOf(dataset.report.upload_options));
  const robots = useRead(readRobots, []);
  return html`<${Card} title="Read again">
    <p class="hint">The uploaded file is read with other options. This data set is deleted unless a job used it.</p>
    <${ImportOptions} value=${value} onchange=${setValue} robots=${robots} />
    <div class="actions"><${Button} kind="primary" onclick=${() => read(queryOf(value))}>Read again<//></div>
  <//>`;
}
