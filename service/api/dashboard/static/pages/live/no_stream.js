// Hint for a model that receives no measured torque.

import { counted } from "../../format.js";
import { html } from "../../preact.js";

/** The reason, and a command that starts a stream. */
export function NoStream({ name, status }) {
  const queries = status.answers?.count ?? 0;
  const panda = status.joint_names[0].startsWith("panda_joint") && status.joint_names.length === 7;
  const play = html`<pre tabindex="0"><code>${panda ? `lipserve stream ${name} --simulate panda --learn` : `lipserve stream ${name} RECORDING.csv --learn`}</code></pre>`;
  if (!status.learns) return html`<div class="empty">Learning is paused, so there is nothing to compare. The model still serves. To continue, select “Resume learning” below.</div>`;
  if (queries) return html`<div class="empty">A stream sends queries (${counted(queries, "answer")} in the last second), but no measured torque. Connect with a stream_id and send tau with every query.${play}</div>`;
  return html`<div class="empty">No stream is connected. ${panda ? "Try a simulated robot; the model learns from it:" : "Play a recording of the robot; the model learns from it:"}${play}
    <p>In your own controller, use StreamClient with a stream_id and send tau with every query, or send observation batches.</p></div>`;
}
