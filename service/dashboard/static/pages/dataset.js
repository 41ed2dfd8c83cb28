// One data set: what its report says, what its signals look like.

import { del, get, path } from "../api.js";
import { h, replace } from "../dom.js";
import { button, card, confirm, heading, link, notice } from "../ui.js";
import { motion } from "./data/motion.js";
import { reportCards, summary } from "./data/report.js";

/** The page `#/data/{id}`. */
export async function render(view, { id }, { signal, title }) {
  const dataset = await get(path`/v1/datasets/${id}`, {}, signal);
  title(dataset.name);
  const remove = button("Delete", async () => {
    const question = `Delete “${dataset.name}” (${dataset.id})? Its samples will be gone. Models trained on it stay, but can no longer be judged on it.`;
    if (!(await confirm(question, "Delete"))) return;
    await del(path`/v1/datasets/${id}`);
    notice(`${dataset.name} is deleted.`);
    location.hash = "#/data";
  }, { kind: "danger" });
  const { report } = dataset;
  const signals = h("div", {});
  replace(
    view,
    heading(dataset.name, link("Train on it", `#/train?datasets=${dataset.id}`, "primary"), remove),
    summary(dataset),
    card("Signals", signals),
    reportCards(report, dataset.joint_names),
  );
  await motion(signals, dataset, signal);
}
