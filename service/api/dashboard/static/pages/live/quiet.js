// What to do where no measured torque comes.

import { h } from "../../dom.js";
import { counted } from "../../format.js";

/** Says why there is nothing to see, and which command would change that. */
export function quiet(name, status) {
  if (!status) return null;
  const asked = status.answers?.count ?? 0;
  const panda = status.joint_names[0].startsWith("panda_joint") && status.joint_names.length === 7;
  const play = h("pre", { tabindex: "0" }, h("code", {}, panda ? `lipserve stream ${name} --simulate panda --learn` : `lipserve stream ${name} RECORDING.csv --learn`));
  if (!status.learns)
    return box("This model still answers, but learning is held, so there is nothing to compare. Press “Learn again” below to go on.");
  if (asked)
    return box(`A stream asks (${counted(asked, "answer")} in the last second), but sends no measured torque. Connect with a stream_id and send tau with every query.`, play);
  return box(panda ? "Nothing streams to this model now. Try a simulated robot, which also teaches the model:" : "Nothing streams to this model now. Play a recording of its robot, which also teaches the model:", play, h("p", {}, "From your own controller: use StreamClient with a stream_id and tau in every query, or send batches of observations."));
}

function box(...children) {
  return h("div", { class: "empty" }, children);
}
