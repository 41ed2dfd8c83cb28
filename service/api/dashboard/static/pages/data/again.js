// Reading the file of a data set again with other options.

import { path, post } from "../../api.js";
import { h, replace } from "../../dom.js";
import { button, card, notice } from "../../ui.js";
import { describeOptions, uploadOptions, withOption } from "./options.js";
import { robots } from "./robots.js";
import { uploadError } from "./upload_error.js";

/** Return {corrections, form}: buttons that correct faults, and a card with all options; null if the file was not kept. */
export async function readingAgain(dataset, signal) {
  const before = dataset.report.upload_options;
  if (!before) return { corrections: null, form: null };
  const options = uploadOptions();
  options.fillRobots(await robots(signal));
  options.fill(before);
  const outcome = h("div", {});
  const read = async (values) => {
    replace(outcome, h("p", { role: "status" }, `Reading ${dataset.name}…`));
    try {
      const query = new URLSearchParams({ ...values, fresh: "true" });
      const made = await post(`${path`/v1/datasets/${dataset.id}/read`}?${query}`, undefined, signal);
      notice(`${dataset.name} read again.`);
      location.hash = `#/data/${made.id}`;
    } catch (error) {
      if (error.name === "AbortError") return;
      const accept = (option, value) => read(withOption(values, option, value));
      replace(outcome, uploadError(dataset.name, error, accept, () => read(values)));
    }
  };
  const remedies = dataset.report.remedies.filter((each) => each.options);
  const corrections = remedies.map((each) => button(`Read again with ${describeOptions(each.options)}`, () => read({ ...before, ...each.options })));
  const form = card(
    "Read again",
    h("p", { class: "hint" }, "The uploaded file is read with other options. This data set is deleted unless a job used it."),
    options.element,
    h("div", { class: "actions" }, button("Read again", () => read(options.values()))),
  );
  return { corrections: h("div", { style: "margin-bottom: 1rem" }, h("div", { class: "actions" }, corrections), outcome), form };
}
