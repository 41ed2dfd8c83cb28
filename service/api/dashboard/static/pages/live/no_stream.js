// Hint for a model that receives no measured torque.

import { h } from "../../dom.js";
import { counted } from "../../format.js";

/** Return the reason and a command that starts a stream. */
export function noStreamHint(name, status) {
  if (!status) return null;
  const queries = status.answers?.count ?? 0;
  const panda = status.joint_names[0].startsWith("panda_joint") && status.joint_names.length === 7;
  const play = h("pre", { tabindex: "0" }, h("code", {}, panda ? `lipserve stream ${name} --simulate panda --learn` : `lipserve stream ${name} RECORDING.csv --learn`));
  if (!status.learns)
    return box("Learning is paused, so there is nothing to compare. The model still serves. To continue, select “Resume learning” below.");
  if (queries)
    return box(`A stream sends queries (${counted(queries, "answer")} in the last second), but no measured torque. Connect with a stream_id and send tau with every query.`, play);
  return box(panda ? "No stream is connected. Try a simulated robot; the model learns from it:" : "No stream is connected. Play a recording of the robot; the model learns from it:", play, h("p", {}, "In your own controller, use StreamClient with a stream_id and send tau with every query, or send observation batches."));
}

function box(...children) {
  return h("div", { class: "empty" }, children);
}
