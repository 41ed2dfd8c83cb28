// The rows of the last minutes, stream by stream.

export const WINDOWS_S = [10, 30, 120];
const KEPT_S = Math.max(...WINDOWS_S);
const GAP_S = 1; // lines have a gap there
const RATE_S = 5;
const SILENT_AFTER_S = 3;
const MAX_STREAMS = 50;

/** Received rows. `version` increases with every change; `chosen` is the shown stream. */
export class Rows {
  #streams = new Map();
  #picked = false;

  constructor(joints) {
    Object.assign(this, { joints, version: 0, received: 0, chosen: null });
  }

  /** Add a part of a `rows` event. */
  add(part) {
    const at = performance.now() / 1000;
    const stream = this.#stream(part.stream_id);
    part.time.forEach((time, index) => {
      // a row with an unreliable time is counted, but not drawn
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
    this.received += part.rows;
    this.version += 1;
    if (this.chosen === null || (!this.#picked && this.age() > SILENT_AFTER_S)) this.chosen = part.stream_id;
  }

  /** Mark rows that a later status reports as outside the training data. */
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

  /** Return the seconds since the last rows of the chosen stream, by the browser's clock; null if there are none. */
  age() {
    const stream = this.#streams.get(this.chosen);
    return stream ? performance.now() / 1000 - stream.heard : null;
  }

  /** Return the newest positions of the chosen stream; null if unknown. */
  pose() {
    return this.#streams.get(this.chosen)?.q ?? null;
  }

  /** Return the event time of the newest row of the chosen stream, Unix s; null if there is none. */
  newest() {
    return this.#streams.get(this.chosen)?.rows.at(-1)?.time ?? null;
  }

  /** Return the recent rates of received and shown rows per second of event time; null if unknown. */
  rate() {
    const parts = this.#streams.get(this.chosen)?.rate ?? [];
    const seconds = parts.length ? parts.at(-1).time - parts[0].time : 0;
    if (seconds < 1) return null;
    const sum = (name) => parts.slice(1).reduce((all, each) => all + each[name], 0) / seconds;
    return { received: sum("rows"), shown: sum("shown") };
  }

  /** Return the rows of the last `seconds`. x: time relative to the newest row, s; cut: whether a gap precedes the row. */
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
      if (this.#streams.size >= MAX_STREAMS) this.#streams.delete(this.streams().find((each) => each !== this.chosen));
      this.#streams.set(name, { rows: [], rate: [], heard: 0, q: null });
    }
    return this.#streams.get(name);
  }
}
