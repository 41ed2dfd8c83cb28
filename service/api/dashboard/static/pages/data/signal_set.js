// Samples of a recording as the plots need them: by quantity and joint, with units.

import { jointVar } from "../../colours.js";
import { count, number, shortNames, timeOrigin } from "../../format.js";
import { nearest } from "./rows.js";

const FEW = 2; // joints that have room for higher plots
const HEIGHTS = { few: 150, many: 96 }; // px of a small plot with its name

/** The preview of a data set. Joints are numbered from 0, base to tip. */
export class SignalSet {
  #columns;

  constructor(preview, { joint_names: joints, report }) {
    this.origin = timeOrigin(preview.columns[0].t[0]); // of the times below
    this.preview = { ...preview, columns: preview.columns.map((each) => ({ ...each, t: each.t.map((time) => time - this.origin) })) };
    this.joints = joints;
    this.names = shortNames(joints);
    this.types = report.joint_types;
    this.#columns = new Map(this.preview.columns.map((each) => [`${each.quantity} ${each.joint}`, each]));
    // the time of each episode may start again: plots over time would overlap
    this.timed = preview.columns.every(({ t }) => t.every((value, index) => index === 0 || value >= t[index - 1]));
  }

  column(quantity, joint) {
    return this.#columns.get(`${quantity} ${this.joints[joint]}`);
  }

  colour(joint) {
    return jointVar(joint);
  }

  rowHeight(joints) {
    return joints <= FEW ? HEIGHTS.few : HEIGHTS.many;
  }

  /** Return the unit of a joint's quantity; an empty text if the type of the joint is unknown. */
  unit(quantity, joint) {
    const [revolute, prismatic = revolute] = this.units(quantity).split(" or ");
    return { revolute, prismatic }[this.types?.[joint]] ?? "";
  }

  /** Return the units that a quantity may have: “rad or m”. */
  units(quantity) {
    return this.preview.columns.find((each) => each.quantity === quantity)?.unit ?? "";
  }

  /** Return the value nearest to x with its unit. */
  valueAt(quantity, joint, axis, x) {
    const column = this.column(quantity, joint);
    if (!column || x === null) return "–";
    return `${number(column.values[nearest(column[axis], x)], 3)}\u00a0${this.unit(quantity, joint)}`.trim();
  }

  /** Return times or rows, and values, with a gap before each episode. */
  line(quantity, joint, axis) {
    const column = this.column(quantity, joint), { starts } = this.preview;
    const x = [], y = [];
    let next = 0;
    column.rows.forEach((row, index) => {
      let breaks = false;
      while (next < starts.length && starts[next] <= row) breaks = starts[next++] > 0;
      if (breaks && index > 0) {
        x.push(column[axis][index]);
        y.push(null);
      }
      x.push(column[axis][index]);
      y.push(column.values[index]);
    });
    return [x, y];
  }

  /** Return the drawn points as a table. */
  table(joints) {
    const points = this.preview.columns.filter((each) => joints.includes(this.joints.indexOf(each.joint)));
    const rows = points.flatMap((each) => each.rows.map((row, index) => [each.joint, each.quantity, this.unit(each.quantity, this.joints.indexOf(each.joint)) || each.unit, row, each.t[index] + this.origin, each.values[index]]));
    return [["joint", "quantity", "unit", "sample", "time, s", "value"], ...rows];
  }

  /** Say how many samples are drawn. */
  drawn() {
    const { columns, samples } = this.preview;
    const drawn = Math.max(...columns.map((column) => column.rows.length));
    if (drawn >= samples) return `Showing all ${count(samples)} samples.`;
    return `Showing ${count(drawn)} points of ${count(samples)} samples: the minimum and the maximum of each interval.`;
  }
}
