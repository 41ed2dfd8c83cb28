// First steps on a new service; hidden once they are done.

import { Badge, Card, Link } from "../../components.js";
import { html } from "../../preact.js";

const SHIPPED = "panda-sim";

/** The steps from a recording to a model, and which are done. */
export function Steps({ hasData, models, jobs }) {
  const isTrained = jobs.some((job) => job.state === "succeeded") || models.some((model) => model.name !== SHIPPED);
  if (hasData && isTrained) return null;
  const done = html`<${Badge} state="done" kind="good" />`;
  return html`<${Card} title="First steps">
    <ol class="steps">
      <li><${Link} to="#/data">Upload a recording<//> of your robot: positions, velocities and torques. ${hasData ? done : html`No robot at hand? Simulate one: <pre><code>lipserve simulate panda panda.csv</code></pre>`}</li>
      <li><${Link} to="#/train">Train a model<//> on it: the defaults suit most recordings. ${isTrained && done}</li>
      <li>Evaluate it on motion that it was not trained on, then stream to it.</li>
    </ol>
    ${models.some((model) => model.name === SHIPPED) && html`<p class="hint">Or explore first: <${Link} to=${`#/models/${SHIPPED}`}>${SHIPPED}<//> is a simulated Panda that comes with LIPServe.</p>`}
  <//>`;
}
