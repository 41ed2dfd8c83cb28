// Findings about a recording, the worst first.

import { Badge } from "../../components.js";
import { html } from "../../preact.js";
import { LABELS, Prose } from "../../prose.js";

const SHORT = 40; // characters; after a shorter sentence, the next one is shown too

/** Describe options: Robot: ur5; Units: q deg. */
export function describeOptions(values) {
  return Object.entries(values)
    .map(([name, value]) => `${LABELS[name] ?? name}: ${value.replace(/[{}"[\]]/g, "").replaceAll(":", " ")}`)
    .join("; ");
}

/** A list of texts of the service. */
export function Sentences({ texts }) {
  return html`<ul>${texts.map((text) => html`<li key=${text}><${Prose} text=${text} /></li>`)}</ul>`;
}

/** A banner with warnings, if there are any. */
export function Warnings({ texts }) {
  return texts.length > 0 && html`<section class="banner" aria-label="Warnings"><strong>Warnings</strong><${Sentences} texts=${texts} /></section>`;
}

/** The worst finding of a report in a sentence or two, with the number of others: a fault, then a warning, then advice. */
export function WorstFinding({ report }) {
  const all = [...new Set([...report.remedies.map((each) => each.text), ...report.warnings, ...report.advice])];
  if (!all.length) return html`<${Badge} state="no issues" kind="good" />`;
  // a remedy that only names the robot corrects no fault
  const fault = report.warnings.includes(all[0]) || report.remedies.some((each) => each.text === all[0] && each.cause !== "robot");
  const [first] = new RegExp(`^.{${SHORT},}?[.!?](?=\\s|$)`, "s").exec(all[0]) ?? [all[0]];
  return html`<div class="finding"><${Badge} state=${fault ? "warning" : "advice"} kind=${fault ? "warn" : "plain"} /> <${Prose} text=${first} />${all.length > 1 && html` <span class="muted">${all.length - 1} more</span>`}</div>`;
}
