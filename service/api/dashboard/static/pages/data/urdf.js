// Upload of a robot's URDF.

import { missingExtraHint } from "../../extras.js";
import { upload } from "../../api.js";
import { h, replace } from "../../dom.js";
import { counted } from "../../format.js";
import { button, errorBox, notice } from "../../ui.js";

/** Create a button that uploads a URDF and then calls onAdded(robot). Errors are shown below it. */
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
      notice(`${robot.name} added, ${counted(robot.joints.length, "joint")}.`);
      onAdded(robot);
    } catch (error) {
      replace(problem, errorBox(error));
    }
  });
  const add = button("Add a URDF", () => input.click());
  return h("div", {}, h("div", { class: "actions" }, add, input), missingExtraHint("robots", add), problem);
}
