// One model live: its state and alarms, then the plots and online learning.

import { get, path } from "../../api.js";
import { Badge, Card, ErrorBox, Heading, useRead } from "../../components.js";
import { count, counted, seconds, sentence } from "../../format.js";
import { plotly } from "../../plots.js";
import { html, useEffect, useRef, useState } from "../../preact.js";
import { verdictState } from "../../verdicts.js";
import { Alarms, Decision } from "./alarms.js";
import { follow } from "./connection.js";
import { NoStream } from "./no_stream.js";
import { useChecking } from "./payload.js";
import { Plots } from "./plots.js";
import { address } from "./robots.js";
import { Rows } from "./rows.js";
import { Answers, Learning, Quality } from "./status.js";
import { Switches } from "./switches.js";

const STALE_AFTER_S = 3;
const MIN_LAG_S = 1; // rows wait for less in normal operation

/** Follow a model until the page is left. */
export function Follow({ name, models, query, signal }) {
  const { status, rows, connection, failure, lost } = useEvents(name, signal);
  const [pausedAt, setPausedAt] = useState(null);
  const checking = useChecking(status);
  const version = useRead((until) => (status ? get(path`/v1/models/${name}/versions/${status.version}`, {}, until) : null), [status?.version]).value;
  if (failure) return html`<${Heading} text=${`${name} live`} /><${ErrorBox} error=${failure} />`;
  const age = rows?.age() ?? null, isLost = connection?.state === "lost", isOld = isLost || age > STALE_AFTER_S;
  const streams = rows?.streams() ?? [];
  const options = models.includes(name) ? models : [name, ...models];
  return html`
    <${Heading} text=${`${name} live`}>
      <${Select} label="Model to follow" options=${options} value=${name} onchange=${(chosen) => (location.hash = address(chosen))} />
      ${streams.length > 1 && html`<${Select} label="Stream to show" options=${streams} value=${rows.chosen} onchange=${(chosen) => rows.choose(chosen)} />`}
      ${rows?.received > 0 && html`<button type="button" onClick=${() => setPausedAt(pausedAt === null ? Date.now() : null)}>${pausedAt === null ? "Pause plots" : "Resume plots"}</button>`}
    <//>
    <div class="now">
      <div>
        <p role="status" class="actions">${states({ status, checking, connection, rows, age, pausedAt }).map(([text, kind]) => html`<${Badge} key=${kind + text} state=${text} kind=${kind} />`)}</p>
        ${rows?.received > 0 && html`<p class="hint">${facts({ rows, age, pausedAt, lost })}</p>`}
      </div>
      ${status && html`<${Answers} answers=${status.answers} />`}
    </div>
    ${status?.held && html`<${Decision} key=${status.held.at} status=${status} name=${name} signal=${signal} />`}
    ${status?.alarms.length > 0 && html`<${Alarms} alarms=${status.alarms} />`}
    ${status && !rows?.received && !isLost && html`<${NoStream} name=${name} status=${status} />`}
    ${rows && html`<${Plots} key=${rows.joints.join()} name=${name} rows=${rows} status=${status} checking=${checking} version=${version} query=${query} isPaused=${pausedAt !== null} isOld=${isOld} />`}
    ${status && html`<div class="grid wide">
      <${Card} title="Learning"><${Switches} name=${name} status=${status} signal=${signal} /><${Learning} status=${status} /><//>
      <${Quality} status=${status} verdict=${version?.verdict} />
    </div>`}`;
}

/** The latest events of a model. `rows` changes in place; the component is drawn again at least every second. */
function useEvents(name, signal) {
  const [status, setStatus] = useState(null), [connection, setConnection] = useState(null), [failure, setFailure] = useState(null);
  const [rows, setRows] = useState(null), [, setTurn] = useState(0);
  const lost = useRef(0);
  useEffect(() => {
    let own = null;
    const onEvent = (event, data) => {
      if (event === "lost") lost.current += data.events;
      if (event === "rows") data.parts.forEach((part) => own?.add(part));
      if (event !== "status") return;
      if (own?.joints.join() !== data.joint_names.join()) setRows((own = new Rows(data.joint_names)));
      data.novel.forEach((each) => own.mark(each));
      setStatus(data);
    };
    plotly().catch(() => null); // load it before the first rows arrive
    follow(name, signal, onEvent, setConnection).catch(setFailure);
    const timer = setInterval(() => setTurn((last) => last + 1), 1000);
    return () => clearInterval(timer);
  }, []);
  return { status, rows, connection, failure, lost: lost.current };
}

/** Return the state of connection, data, learning and payload: [[text, kind of badge], …]. */
function states({ status, checking, connection, rows, age, pausedAt }) {
  const found = [];
  if (!connection) found.push(["connecting", "busy"]);
  else if (connection.state === "lost") found.push([`connection lost. ${sentence(connection.why)} Data is outdated. Retrying`, "bad"]);
  else if (!rows?.received) found.push(["connected, no rows yet", "plain"]);
  else if (age > STALE_AFTER_S) found.push(["no new rows, data is outdated", "warn"]);
  else found.push(["live", "good"]);
  if (pausedAt !== null) found.push(["plots paused, still receiving rows", "warn"]);
  if (!status) return found;
  if (status.held) found.push(["learning paused by a change", "warn"]);
  else if (!status.learns) found.push(["learning paused", "warn"]);
  else if (status.failure) found.push(["learning failed", "bad"]);
  else if (status.lag_s >= MIN_LAG_S) found.push([`learning ${seconds(status.lag_s)} behind`, "busy"]);
  else if (rows?.received) found.push(["learning up to date", "good"]);
  if (status.windows[0].rows && age <= STALE_AFTER_S) found.push(verdictState(status.verdict));
  if (checking.size) found.push(["checking payload", "busy"]);
  return found;
}

function facts({ rows, age, pausedAt, lost }) {
  const rate = rows.rate();
  return [
    `Stream ${rows.chosen}.`,
    age > STALE_AFTER_S ? `Last row ${Math.round(age)} s ago.` : "",
    rate ? `Receiving ${counted(Math.round(rate.received), "row")} per second, ${count(Math.round(rate.shown))} of them shown; rejected rows take precedence.` : "",
    pausedAt === null ? "" : `Plots paused since ${new Date(pausedAt).toLocaleTimeString("en-GB")}.`,
    lost ? `${counted(lost, "event")} skipped because this page was too slow.` : "",
  ].filter(Boolean).join(" ");
}

function Select({ label, options, value, onchange }) {
  return html`<select aria-label=${label} class="inline" value=${value} onChange=${(event) => onchange(event.target.value)}>${options.map((each) => html`<option key=${each} value=${each} selected=${each === value}>${each}</option>`)}</select>`;
}
