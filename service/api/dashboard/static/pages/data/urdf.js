// Upload of a robot's URDF.

import { missingExtraHint } from "../../extras.js";
import { upload } from "../../api.js";
import { h, replace } from "../../dom.js";
import { counted } from "../../format.js";
import { button, errorBox, notice } from "../../ui.js";

/** Create a button that uploads a URDF and then calls onAdded(robot). Errors are shown below it. */
export function urdfButton(onAdded) {
  const input = h("input", { type: "file", accept: ".urdf,.xacro,.sdf,.xml,.zip", hidden: true, "aria-label": "URDF to upload" });
  const problem = h("div", {});
  // scale: factors to SI units that an error message proposed
  const send = async (file, scale) => {
    replace(problem);
    try {
      const robot = await upload(file, { scale }, undefined, undefined, "/v1/robots");
      notice(`${robot.name} added, ${counted(robot.joints.length, "joint")}.`);
      onAdded(robot);
    } catch (error) {
      const proposed = /set scale=([\w=.,-]+)/.exec(error.message)?.[1];
      const mend = proposed && h("div", { class: "actions" }, button("Upload in these units", () => send(file, proposed)));
      replace(problem, errorBox(error), mend ?? null);
    }
  };
  input.addEventListener("change", () => {
    const [file] = input.files;
    input.value = "";
    if (file) send(file, "");
  });
  const add = button("Add a URDF", () => input.click());
  return h("div", {}, h("div", { class: "actions" }, add, input), missingExtraHint("robots", add), problem);
}
