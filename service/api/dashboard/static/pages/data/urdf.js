// Adding a robot of one's own: the upload of its URDF.

import { lacking } from "../../abilities.js";
import { upload } from "../../api.js";
import { h, replace } from "../../dom.js";
import { counted } from "../../format.js";
import { button, errorBox, notice } from "../../ui.js";

/** A button that uploads a URDF; onAdded(robot) is called then. What is refused is shown below it. */
export function urdfButton(onAdded) {
  const input = h("input", { type: "file", accept: ".urdf,.xml", hidden: true, "aria-label": "URDF to upload" });
  const problem = h("div", {});
  input.addEventListener("change", async () => {
    const [file] = input.files;
    input.value = "";
    if (!file) return;
    replace(problem);
    try {
      const robot = await upload(file, {}, undefined, undefined, "/v1/robots");
      notice(`${robot.name}, ${counted(robot.joints.length, "joint")}, is added.`);
      onAdded(robot);
    } catch (error) {
      replace(problem, errorBox(error));
    }
  });
  const add = button("Add a URDF", () => input.click());
  return h("div", {}, h("div", { class: "actions" }, add, input), lacking("robots", add), problem);
}
