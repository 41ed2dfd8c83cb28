// The plots of a stream over a common time axis, and beside them the arm, payload and external torque.

import { LinkedPlots } from "../../linked.js";
import { html, useEffect, useMemo, useRef, useState } from "../../preact.js";
import { alarmMarks } from "./alarms.js";
import { LiveArm } from "./arm.js";
import { Innovation } from "./innovation.js";
import { External, Payload } from "./payload.js";
import { WINDOWS_S } from "./rows.js";
import { largestJoint, recentInnovations } from "./scores.js";
import { Toolbar } from "./toolbar.js";
import { Torque } from "./torque.js";

const DRAW_MS = 300;
const PAUSE_FACTOR = 3; // pause after drawing, relative to its duration
const MAX_PAUSE_MS = 1500;
const DEFAULT_WINDOW_S = 30;

/** The plots of the chosen stream; they appear with its first rows. */
export function Plots({ name, rows, status, checking, version, query, isPaused, isOld }) {
  const { joint_names: joints, joint_types: types } = status;
  const [view, setView] = useView(name, joints, query);
  const [cursor, setCursor] = useState(null);
  const linked = useMemo(() => new LinkedPlots({ moved: setCursor, stays: false }), []);
  const shown = useFrames(rows, view.window, isPaused);
  const largest = useRef(null);
  const scores = shown && recentInnovations(shown, joints);
  if (shown) largest.current = largestJoint(scores, largest.current);
  useEffect(() => {
    if (shown) linked.mark(alarmMarks(status.alarms, rows.chosen, rows.newest()));
  }, [shown]);
  const point = (x) => {
    linked.point(x);
    setCursor(x);
  };
  const joint = view.joint ?? largest.current;
  const common = { shown, joints, linked, window: view.window };
  return html`<div class="stage">
    ${shown && html`<div class=${isOld ? "old" : ""}>
      <${Toolbar} view=${view} setView=${setView} cursor=${cursor} point=${point} />
      <${Torque} ...${common} types=${types} scores=${scores} largest=${largest.current} picked=${view.joint} cursor=${cursor} pick=${(picked) => setView({ joint: picked === view.joint ? null : picked })} />
      <${Innovation} ...${common} threshold=${status.contact_threshold} joint=${joint} />
    </div>`}
    <div class="aside">
      ${shown && version && html`<${LiveArm} key=${version.version} version=${version} q=${rows.pose()} joint=${joint} />`}
      <${Payload} payloads=${status.payloads} checking=${checking} />
      ${shown && html`<${External} rows=${shown} joints=${joints} types=${types} />`}
    </div>
  </div>`;
}

/** The view {window, joint}, stored in the query of the address; joint: index of the enlarged one, or null. */
function useView(name, joints, query) {
  const [view, set] = useState(() => {
    const window = Number(query.get("window")), joint = joints.indexOf(query.get("joint"));
    return { window: WINDOWS_S.includes(window) ? window : DEFAULT_WINDOW_S, joint: joint < 0 ? null : joint };
  });
  const change = (changed) => {
    const next = { ...view, ...changed };
    const kept = { ...(next.window === DEFAULT_WINDOW_S ? {} : { window: next.window }), ...(next.joint === null ? {} : { joint: joints[next.joint] }) };
    const search = new URLSearchParams(kept).toString();
    history.replaceState(null, "", `#/live/${encodeURIComponent(name)}${search && `?${search}`}`);
    set(next);
  };
  return [view, change];
}

/** Return the rows to draw: new ones every DRAW_MS, less often on a slow machine, so that the page stays responsive. */
function useFrames(rows, window, isPaused) {
  const [shown, setShown] = useState(null);
  const last = useRef({ version: null, began: 0, next: 0 }).current;
  useEffect(() => {
    last.version = null;
    last.next = 0;
  }, [window]);
  useEffect(() => {
    const look = () => {
      if (!rows.received || isPaused || document.hidden || rows.version === last.version || Date.now() < last.next) return;
      Object.assign(last, { version: rows.version, began: Date.now() });
      setShown(rows.shown(window));
    };
    const timer = setInterval(look, DRAW_MS);
    return () => clearInterval(timer);
  }, [window, isPaused]);
  useEffect(() => {
    if (shown) last.next = Date.now() + Math.min(PAUSE_FACTOR * (Date.now() - last.began), MAX_PAUSE_MS);
  }, [shown]);
  return shown;
}
