// Live page: list of streaming robots, or live plots and online learning of one model.

import { pages } from "../api.js";
import { h, refresh, replace } from "../dom.js";
import { count, counted, sentence } from "../format.js";
import { LinkedPlots } from "../linked.js";
import { plotly } from "../plots.js";
import { card, heading, select, updateSelect } from "../ui.js";
import { alarmMarks, alarms } from "./live/alarms.js";
import { payloadCard, externalCard } from "./live/payload.js";
import { follow } from "./live/connection.js";
import { innovation } from "./live/innovation.js";
import { liveArm } from "./live/arm.js";
import { noStreamHint } from "./live/no_stream.js";
import { address, robots } from "./live/robots.js";
import { Rows } from "./live/rows.js";
import { latencyLine, learningFacts, qualityCard } from "./live/status.js";
import { switches } from "./live/switches.js";
import { toolbar } from "./live/toolbar.js";
import { torque } from "./live/torque.js";

const DRAW_MS = 300;
const MAX_MODELS = 500;
const STALE_AFTER_S = 3;
const PAUSE_FACTOR = 3; // pause after drawing, relative to its duration
const MAX_PAUSE_MS = 1500;

/** The pages `#/live`, a list of robots, and `#/live/{name}`; `?window=120&joint=joint4` sets the view. */
export async function render(view, { name, query }, { signal, title }) {
  title(name ? `${name} live` : "Live");
  if (!name) return robots(view, signal);
  const models = (await pages("/v1/models", MAX_MODELS, {}, signal)).map((model) => model.name);
  await followModel(view, name, models, query, signal);
}

/** Follow a model until the page is left; throw permanent errors of the service. */
async function followModel(view, name, models, query, signal) {
  const learning = switches(name, signal);
  const page = parts(name, models, learning.element);
  const seen = { rows: null, status: null, connection: null, pausedAt: null, drawn: 0, drawAt: 0, lost: 0 };
  const choice = { window: 30, joint: null, cursor: null };
  const stream = streamSelect(seen);
  let plots = null, drawing = false;
  plotly(); // load it before the first rows arrive

  const redraw = () => {
    seen.drawn = -1;
    seen.drawAt = 0;
  };
  const point = (x) => {
    choice.cursor = x;
    linked.point(x);
    tools?.point(x);
    plots?.torque.point();
  };
  const linked = new LinkedPlots({ moved: point, stays: false });
  let tools = null;

  const begin = (status) => {
    const { joint_names: joints, joint_types: types } = status;
    if (seen.rows?.joints.join() === joints.join()) return;
    seen.rows = new Rows(joints);
    tools = toolbar(name, joints, choice, query, { changed: redraw, point });
    replace(page.tools, tools.element);
    const pick = (joint) => tools.pick(joint);
    plots = {
      torque: torque(page.torque, joints, types, choice, linked, { pick, signal }),
      innovation: innovation(page.innovation, joints, choice, linked, signal),
      arm: liveArm(page.arm, name, () => seen.rows.pose(), signal),
    };
    redraw();
  };
  const onEvent = (event, data) => {
    if (event === "lost") seen.lost += data.events;
    if (event === "rows") data.parts.forEach((part) => seen.rows?.add(part));
    if (event !== "status") return;
    begin(data);
    seen.status = data;
    data.novel.forEach((rows) => seen.rows.mark(rows));
    learning.update(data);
    update();
  };
  const update = () => {
    showState(page, seen, name);
    if (!seen.status) return;
    page.status.hidden = false;
    refresh(page.payload, payloadCard(seen.status));
    refresh(page.learning, learningFacts(seen.status));
    refresh(page.quality, qualityCard(seen.status));
    refresh(page.latency, latencyLine(seen.status));
    alarms(page, seen.status, name, signal);
    const names = seen.rows.streams();
    refresh(page.streams, names.length < 2 ? null : updateSelect(stream, names, seen.rows.chosen));
  };
  const draw = async () => {
    if (!seen.rows?.received || drawing || seen.pausedAt !== null || document.hidden || seen.drawn === seen.rows.version) return;
    if (Date.now() < seen.drawAt) return;
    drawing = true;
    seen.drawn = seen.rows.version;
    const began = Date.now();
    try {
      page.plots.hidden = false; // a plot takes its width from its visible place
      const shown = seen.rows.shown(choice.window);
      const joint = await plots.torque.draw(shown);
      linked.mark(alarmMarks(seen.status.alarms, seen.rows.chosen, seen.rows.newest()));
      refresh(page.external, externalCard(shown, seen.rows.joints, seen.status.joint_types));
      await plots.arm.draw(seen.status, joint);
      await plots.innovation.draw(shown, seen.status, joint);
    } finally {
      drawing = false;
      // draw less often on a slow machine, so that the page stays responsive
      if (seen.drawn !== -1) seen.drawAt = Date.now() + Math.min(PAUSE_FACTOR * (Date.now() - began), MAX_PAUSE_MS);
    }
  };
  page.pause.addEventListener("click", () => {
    seen.pausedAt = seen.pausedAt === null ? Date.now() : null;
    page.pause.textContent = seen.pausedAt === null ? "Pause plots" : "Resume plots";
    update();
  });

  replace(view, page.all);
  update();
  const timers = [setInterval(draw, DRAW_MS), setInterval(() => showState(page, seen, name), 1000)];
  document.addEventListener("themechange", redraw);
  signal.addEventListener("abort", () => {
    timers.forEach(clearInterval);
    document.removeEventListener("themechange", redraw);
  });
  await follow(name, signal, onEvent, (connection) => {
    seen.connection = connection;
    update();
  });
}

/** Create the parts of the page. */
function parts(name, models, learning) {
  const places = ["about", "hint", "decision", "payload", "external", "learning", "quality", "latency", "alarms", "tools", "torque", "arm", "innovation"];
  const page = Object.fromEntries(places.map((each) => [each, h("div")]));
  page.state = h("p", { role: "status", class: "actions" });
  page.about.className = "hint";
  page.pause = h("button", { type: "button" }, "Pause plots");
  page.streams = h("span");
  const choice = select(models.includes(name) ? models : [name, ...models], name, (chosen) => (location.hash = address(chosen)));
  choice.setAttribute("aria-label", "Model to follow");
  choice.style.width = "auto";
  page.plots = h("div", { hidden: true }, page.tools, page.torque, page.innovation);
  const stage = h("div", { class: "stage" }, page.plots, h("div", { class: "aside" }, page.arm, page.payload, page.external));
  page.status = h("div", { class: "grid wide", hidden: true }, card("Learning", learning, page.learning), page.quality);
  const top = h("div", { class: "now" }, h("div", {}, page.state, page.about), page.latency);
  page.all = [heading(`${name} live`, choice, page.streams, page.pause), top, page.decision, page.hint, stage, page.status, page.alarms];
  return page;
}

/** Show the state of the connection and the age of the data. */
function showState(page, seen, name) {
  const { rows, status, connection } = seen;
  const age = rows?.age() ?? null;
  const lost = connection?.state === "lost";
  const words = [];
  if (!connection) words.push(["busy", "◌ connecting"]);
  else if (lost) words.push(["bad", `✕ connection lost. ${sentence(connection.why)} Data is outdated. Retrying`]);
  else if (!rows?.received) words.push(["plain", "· connected, no rows yet"]);
  else if (age > STALE_AFTER_S) words.push(["warn", "! no new rows, data is outdated"]);
  else words.push(["good", "✓ live"]);
  if (seen.pausedAt !== null) words.push(["warn", "! plots paused, still receiving rows"]);
  refresh(page.state, ...words.map(([kind, text]) => h("span", { class: `badge ${kind}`, style: "white-space: normal" }, text)));
  page.pause.hidden = !rows?.received;
  page.plots.classList.toggle("old", lost || age > STALE_AFTER_S);
  refresh(page.hint, rows?.received || lost ? null : noStreamHint(name, status));
  refresh(page.about, rows?.received ? streamFacts(seen, age) : null);
}

function streamFacts({ rows, lost, pausedAt }, age) {
  const rate = rows.rate();
  const texts = [
    `Stream ${rows.chosen}. `,
    age > STALE_AFTER_S ? `Last row ${Math.round(age)} s ago. ` : null,
    rate ? `Receiving ${counted(Math.round(rate.received), "row")} per second, ${count(Math.round(rate.shown))} of them shown; rejected rows take precedence. ` : null,
    pausedAt === null ? null : `Plots paused since ${new Date(pausedAt).toLocaleTimeString("en-GB")}. `,
    lost ? `${counted(lost, "event")} skipped because this page was too slow. ` : null,
  ];
  return h("p", {}, texts);
}

/** Create the select of the stream. */
function streamSelect(seen) {
  const made = select([], null, (name) => {
    seen.rows.choose(name);
    seen.drawn = -1;
  });
  made.setAttribute("aria-label", "Stream to show");
  made.style.width = "auto";
  return made;
}
