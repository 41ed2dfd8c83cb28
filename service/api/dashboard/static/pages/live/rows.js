// The rows of the last minutes, stream by stream.

export const WINDOWS_S = [10, 30, 120];
const KEPT_S = Math.max(...WINDOWS_S);
const GAP_S = 1; // lines do not cross it
const RATE_S = 5;
const SILENT_S = 3;
const MOST_STREAMS = 50;

/** Rows that came; `version` grows with every change, `chosen` is the stream that is shown. */
export class Rows {
  #streams = new Map();
  #picked = false;

  constructor(joints) {
    Object.assign(this, { joints, version: 0, came: 0, chosen: null });
  }

  /** Take a part of a `rows` event. */
  take(part) {
    const at = performance.now() / 1000;
    const stream = this.#stream(part.stream_id);
    part.time.forEach((time, index) => {
      // a row whose time is in doubt has no place in a plot over time; it is counted
      if (time === null || part.code[index] === "time_jump") return;
      const std = part.std[index].map((std, joint) => (std === null ? null : Math.hypot(std, part.noise_std[joint])));
      stream.rows.push({ time, tau: part.tau[index], mean: part.mean[index], std, code: part.code[index], novel: false });
    });
    stream.rows.sort((one, other) => one.time - other.time);
    const newest = stream.rows.at(-1)?.time ?? 0;
    stream.rows = stream.rows.filter((row) => row.time >= newest - KEPT_S);
    stream.rate.push({ time: newest, rows: part.rows, shown: part.time.length });
    stream.rate = stream.rate.filter((each) => each.time > newest - RATE_S);
    stream.heard = at;
    if (part.q.length && !part.q.includes(null)) stream.q = part.q;
    this.came += part.rows;
    this.version += 1;
    if (this.chosen === null || (!this.#picked && this.age() > SILENT_S)) this.chosen = part.stream_id;
  }

  /** Mark rows that lie beyond what the version's basis covers, as a status says some time later. */
  mark({ stream_id, times }) {
    const novel = new Set(times);
    for (const row of this.#streams.get(stream_id)?.rows ?? []) row.novel ||= novel.has(row.time);
    this.version += 1;
  }

  choose(name) {
    [this.chosen, this.#picked] = [name, true];
    this.version += 1;
  }

  streams() {
    return [...this.#streams.keys()].sort();
  }

  /** Seconds since rows of the chosen stream came, by this browser's clock; null: none did. */
  age() {
    const stream = this.#streams.get(this.chosen);
    return stream ? performance.now() / 1000 - stream.heard : null;
  }

  /** Positions of the chosen stream's newest row that is shown, null where none is known. */
  pose() {
    return this.#streams.get(this.chosen)?.q ?? null;
  }

  /** Event time of the chosen stream's newest row, Unix seconds; null: there is none. */
  newest() {
    return this.#streams.get(this.chosen)?.rows.at(-1)?.time ?? null;
  }

  /** Rows a second of the robot's own time that came and that were shown lately; null: not known yet. */
  rate() {
    const parts = this.#streams.get(this.chosen)?.rate ?? [];
    const seconds = parts.length ? parts.at(-1).time - parts[0].time : 0;
    if (seconds < 1) return null;
    const sum = (name) => parts.slice(1).reduce((all, each) => all + each[name], 0) / seconds;
    return { came: sum("rows"), shown: sum("shown") };
  }

  /** Rows of the last so many seconds, `x` seconds after the newest one (so never positive), `cut` where the line does not go on. */
  shown(seconds) {
    const all = this.#streams.get(this.chosen)?.rows ?? [];
    const newest = all.at(-1)?.time ?? 0;
    const rows = all.filter((row) => row.time >= newest - seconds);
    return rows.map((row, index) => ({
      ...row,
      x: row.time - newest,
      cut: index > 0 && row.time - rows[index - 1].time > GAP_S,
    }));
  }

  #stream(name) {
    if (!this.#streams.has(name)) {
      if (this.#streams.size >= MOST_STREAMS) this.#streams.delete(this.streams().find((each) => each !== this.chosen));
      this.#streams.set(name, { rows: [], rate: [], heard: 0, q: null });
    }
    return this.#streams.get(name);
  }
}
