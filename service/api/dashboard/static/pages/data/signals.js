// Signals of a data set as small plots, one a joint and quantity, with a common cursor and zoom. Dragging selects the range to hold out.

import { get, path } from "../../api.js";
import { Await, Card, Choice, useRead } from "../../components.js";
import { Export } from "../../exporting.js";
import { count, number } from "../../format.js";
import { html, useMemo, useRef, useState } from "../../preact.js";
import { HoldOut, rangeOf, rowsWithin } from "./hold_out.js";
import { QUANTITIES, useMultiples } from "./multiples.js";
import { SignalSet } from "./signal_set.js";

const POINTS = 1000;
const ALL = "all joints";
const AXES = [["t", "time"], ["rows", "sample number"]];
const DRAGS = [["zoom", "Zoom all plots"], ["hold", "Select the range to hold out"]];

/** The card. rows: [first, last) to hold out, null for none; choose(rows): called when the selection changes. */
export function Signals({ dataset, rows, choose }) {
  const preview = useRead((signal) => get(path`/v1/datasets/${dataset.id}/preview`, { points: POINTS }, signal), [dataset.id]);
  return html`<${Card} title="Signals"><${Await} reading=${preview} what="Loading the signals">${(found) => html`<${View} preview=${found} dataset=${dataset} rows=${rows} choose=${choose} />`}<//><//>`;
}

function View({ preview: read, dataset, rows, choose }) {
  const signals = useMemo(() => new SignalSet(read, dataset), [read]), { preview } = signals;
  const [joint, setJoint] = useState(ALL), [axis, setAxis] = useState(signals.timed ? "t" : "rows"), [drag, setDrag] = useState("zoom");
  const rising = signals.timed || axis === "rows";
  const first = rising ? preview.columns[0][axis][0] : null;
  const [cursor, setCursor] = useState(first);
  const all = useRef(null);
  const joints = joint === ALL ? signals.joints.map((_each, index) => index) : [signals.joints.indexOf(joint)];
  const { places, point, reset } = useMultiples(signals, {
    joints,
    axis,
    stretch: rising ? rangeOf(preview, axis, rows) : null,
    dragging: drag === "hold",
    moved: setCursor,
    chosen: (range) => choose(range && rowsWithin(preview, axis, range)),
  });
  const turn = (to) => {
    setAxis(to);
    setCursor(signals.timed || to === "rows" ? preview.columns[0][to][0] : null);
    point(null);
  };
  const at = rising ? cursor : null;
  const move = (x) => {
    setCursor(x);
    point(x);
  };
  const ends = [preview.columns[0][axis][0], preview.columns[0][axis].at(-1)];
  const text = at === null ? "The times of the episodes overlap" : axis === "t" ? `At ${number(at, 5)} s` : `At sample ${count(at)}`;
  return html`
    <div class="grid thirds">
      <${Choice} label="Joint" options=${[ALL, ...signals.joints]} value=${joint} onchange=${setJoint} />
      <${Choice} label="Horizontal axis" options=${AXES} value=${axis} onchange=${turn} />
      <${Choice} label="Drag action" options=${DRAGS} value=${drag} onchange=${setDrag} />
    </div>
    <div class="cursor-bar">
      <output>${text}</output>
      <input type="range" step="any" aria-label="Cursor" min=${ends[0]} max=${ends[1]} disabled=${!rising} value=${at ?? ends[0]} aria-valuetext=${text} onInput=${(event) => move(event.target.valueAsNumber)} />
    </div>
    <div class="quantities" ref=${all}>${QUANTITIES.map(([quantity, name], index) => html`<section key=${quantity} aria-label=${name}>
      <h3>${name} <span class="muted">${[quantity, dataset.report.derived.includes(quantity) && "derived", !signals.types && signals.units(quantity)].filter(Boolean).join(", ")}</span></h3>
      <div class="multiple" style=${`--rows: ${joints.length}; --row: ${signals.rowHeight(joints.length)}px`}>
        <div class="strip" role="img" aria-label=${name} ref=${places[index]}></div>
        <ul aria-label=${`${name} at the cursor`}>${joints.map((each) => html`<li key=${each}><span class="joint" style=${`--own: ${signals.colour(each)}`} title=${signals.joints[each]}>${signals.names[each]}</span><output>${signals.valueAt(quantity, each, axis, at)}</output></li>`)}</ul>
      </div>
    </section>`)}</div>
    <div class="row below"><button type="button" onClick=${reset}>Reset zoom</button><p class="hint">${signals.drawn()} Lines have a gap between episodes.</p>
      <${Export} name=${`signals of ${dataset.name}`} of=${() => all.current} table=${() => signals.table(joints)} /></div>
    <${HoldOut} preview=${preview} dataset=${dataset} rows=${rows} axis=${axis} rising=${rising} choose=${choose} />`;
}
