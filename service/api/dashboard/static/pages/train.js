// Form that starts a training job.

import { pages, post } from "../api.js";
import { h, replace } from "../dom.js";
import { card, errorBox, field, heading, notice, select } from "../ui.js";
import { robotSelect, robots } from "./data/robots.js";
import { advancedOptions } from "./train/advanced.js";
import { rowsOf } from "./data/hold_out.js";
import { datasetChoice } from "./train/choice.js";
import { ESTIMATORS, estimatorChoice } from "./train/estimators.js";
import { holdoutChoice } from "./train/holdout.js";

const PROMOTION = [
  ["", "default of the service"],
  ["ask", "only if it passes the held-out check"],
  ["always", "always"],
];

/** The page `#/train`; `?datasets=ID,ID&model=NAME` fills the form, `&hold_out=300-450` holds out rows of a single data set. */
export async function render(view, { query }, { signal, title }) {
  title("Train a model");
  const [datasets, models] = await Promise.all([
    pages("/v1/datasets", 200, {}, signal),
    pages("/v1/models", 200, {}, signal),
  ]);
  const known = new Map(models.map((each) => [each.name, each]));
  const robot = robotSelect({ none: "none: learn the joint axes from the torque", withUrdf: true });
  const withRobot = h("div", {}, field("Robot", robot.select, "Optional. Training then starts from the robot’s URDF; joints are matched by name."), robot.note, robot.add);
  const enableRobot = (usesRobot) => {
    withRobot.hidden = !usesRobot;
    robot.select.disabled = !usesRobot;
  };
  let estimator = ESTIMATORS[0][0];
  const estimators = estimatorChoice((name, usesRobot) => {
    estimator = name;
    enableRobot(usesRobot);
  });
  enableRobot(ESTIMATORS[0][2]);
  const showRobot = () => estimators.robot(robot.select.value ? robot.select.selectedOptions[0].textContent : "");
  robot.select.addEventListener("change", showRobot);

  const { element: nameField, input: model } = modelName(known, query.get("model"));
  const preselected = (query.get("datasets") ?? "").split(",");
  const choice = datasetChoice(datasets, preselected, (picked) => {
    const names = new Set(picked.map((each) => each.report.robot));
    if (names.size === 1 && !robot.select.value) robot.choose([...names][0]);
    showRobot();
  });
  const rows = preselected.length === 1 ? rowsOf(query.get("hold_out")) : null;
  const holdout = holdoutChoice(rows && { [preselected[0]]: [rows] });
  const promotion = select(PROMOTION, "");
  promotion.name = "promotion";
  const advanced = advancedOptions(signal);
  const problems = h("div", {});
  const start = h("button", { type: "submit", class: "primary" }, "Start training");

  const submit = async (event) => {
    event.preventDefault();
    const picked = choice.chosen();
    if (!picked.length) {
      replace(problems, h("div", { class: "error", role: "alert" }, "Choose at least one recording to train on."));
      form.querySelector("[name=datasets]:not(:disabled)")?.focus();
      return;
    }
    const request = { model: model.value.trim(), datasets: picked.map((each) => each.id), estimator, options: advanced.values() };
    if (promotion.value) request.promotion = promotion.value;
    request.holdout = holdout.value();
    if (!robot.select.disabled && robot.select.value) request.robot = robot.select.value;
    if (advanced.jointTypes().length) request.joint_types = advanced.jointTypes();
    start.disabled = true;
    replace(problems);
    try {
      const job = await post("/v1/jobs", request, signal);
      location.hash = `#/jobs/${job.id}`;
    } catch (error) {
      start.disabled = false;
      if (error.name === "AbortError") return;
      replace(problems, errorBox(error));
      const field = error.detail?.[0]?.field?.replace(/\[.*/, "");
      const wrong = field && form.querySelector(`[name="${CSS.escape(field)}"]`);
      wrong?.closest("details")?.setAttribute("open", "");
      wrong?.focus();
    }
  };
  const form = h(
    "form",
    { onsubmit: submit },
    card("Recordings", choice.element),
    card("Model", nameField, estimators.element, withRobot),
    card("Evaluation", holdout.element, field("Start serving the new version", promotion, "The held-out check requires a 95\u00a0% coverage of at least 90\u00a0% on every joint, and predictions no worse than those of the serving version.")),
    card("Options", h("p", { class: "hint" }, "The defaults suit most recordings."), advanced.element),
    problems,
    h("div", { class: "actions" }, start),
  );
  replace(view, heading("Train a model"), form);
  choice.changed?.();
  robots(signal).then(
    (found) => {
      robot.fill(found);
      choice.changed?.();
      showRobot();
    },
    (error) => error.name === "AbortError" || notice(`The robots could not be loaded: ${error.message}`, "bad"),
  );
}

function modelName(known, given) {
  const input = h("input", {
    type: "text",
    name: "model",
    value: given ?? "",
    required: true,
    pattern: "[a-z0-9][a-z0-9._\\-]{0,63}",
    title: "Lower-case letters, digits, dots, underscores and hyphens; max 64",
    placeholder: "my-arm",
    autocomplete: "off",
    autocapitalize: "none",
    spellcheck: "false",
    list: "models-known",
  });
  const about = h("p", { class: "hint", role: "status" });
  const describe = () => {
    const model = known.get(input.value.trim());
    const has = model?.latest_version === 1 ? "version 1" : `versions up to ${model?.latest_version}`;
    about.textContent = model
      ? `${model.name} has ${has}. The new version serves if it passes the held-out check. Otherwise it becomes a candidate.`
      : "";
  };
  input.addEventListener("input", describe);
  describe();
  const list = h("datalist", { id: "models-known" }, [...known.keys()].map((name) => h("option", { value: name })));
  return { input, element: [field("Model name", input, "Lower-case letters, digits, dots, underscores and hyphens."), about, list] };
}
