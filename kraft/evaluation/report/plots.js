// Plots of a drive over its time; replay.js moves their cursor. Units are m, s and rad.

const APART = 18; // usual distance between two values at an axis, px

/** Round times from 0 to `end`, at most seven of them. */
function roundTimes(end) {
  const step = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500].find((step) => end / step <= 6) ?? 1000;
  return Array.from({ length: Math.floor(end / step + 1e-9) + 1 }, (_, k) => k * step);
}

/** Round values from `low` to `high` in steps of 1, 2 or 5: about `most` of them, two at least; with their number of decimals. */
function roundValues(low, high, most) {
  const least = (high - low) / most, power = 10 ** Math.floor(Math.log10(least));
  const step = power * [1, 2, 5, 10].find((factor) => factor * power >= least * (1 - 1e-9));
  const first = Math.ceil(low / step - 1e-6), last = Math.floor(high / step + 1e-6);
  if (last - first < 1) return roundValues(low, high, most + 1);
  const decimals = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  return { decimals, values: Array.from({ length: last - first + 1 }, (_, k) => (first + k) * step) };
}

/** A plot over the time of the drive; `lines` are {name, look, times, values}. */
class Plot {
  constructor(drive, title, unit, lines, low = null) {
    Object.assign(this, { drive, title, unit, lines });
    const all = lines.flatMap((line) => line.values).filter((value) => value !== null);
    const most = (a, b) => Math.max(a, b), least = (a, b) => Math.min(a, b); // of any number: a call has a limited one
    this.low = low ?? all.reduce(least, 0);
    this.high = all.reduce(most, this.low + 1e-3);
    this.value = make("span", { class: "value" });
    this.svg = draw("svg", { class: "plot", role: "img", "aria-label": `${title} over time` });
    this.element = make("figure", { "aria-label": title }, make("figcaption", {}, `${title} `, this.value), this.svg);
  }

  /** Draw the plot in a width and a height in pixels. */
  render(width, height) {
    const left = 58, right = 16, top = 6, bottom = 20, floor = height - 14; // px; the words of the axis are below the floor
    this.x = (time) => left + ((width - left - right) * time) / this.drive.end;
    this.timeAt = (x) => Math.min(this.drive.end, Math.max(0, ((x - left) / (width - left - right)) * this.drive.end));
    const y = (value) => height - bottom - ((height - top - bottom) * (value - this.low)) / (this.high - this.low);
    this.svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    this.svg.setAttribute("height", height);
    const parts = [];
    this.drive.cycles.forEach((cycle, k) => {
      if (cycle.kind !== "contingency") return;
      const end = this.drive.cycles[k + 1]?.t ?? this.drive.end;
      parts.push(draw("rect", { class: "stopping", x: this.x(cycle.t), width: Math.max(0, this.x(end) - this.x(cycle.t)), y: 0, height: floor }));
    });
    for (const time of roundTimes(this.drive.end)) {
      parts.push(draw("line", { class: "grid", x1: this.x(time), x2: this.x(time), y1: height - bottom, y2: floor }));
      parts.push(draw("text", { x: this.x(time), y: height - 3, "text-anchor": "middle" }, `${Number(time.toFixed(1))} s`));
    }
    const { values, decimals } = roundValues(this.low, this.high, Math.max(1, Math.floor((height - top - bottom) / APART)));
    values.forEach((value, k) => {
      const number = (value === 0 ? 0 : value).toFixed(decimals).replace("-", "\u2212");
      const words = k === values.length - 1 ? `${number} ${this.unit}`.trim() : number;
      parts.push(draw("line", { class: value === 0 ? "zero" : "grid", x1: left, x2: width - right, y1: y(value), y2: y(value) }));
      parts.push(draw("text", { class: "level", x: left - 6, y: y(value) + 4, "text-anchor": "end" }, words));
    });
    for (const line of this.lines) {
      let d = "", joined = false;
      line.values.forEach((value, i) => {
        if (value === null) { joined = false; return; }
        d += `${joined ? "L" : "M"}${this.x(line.times[i]).toFixed(1)} ${y(value).toFixed(1)}`;
        joined = true;
      });
      parts.push(draw("path", { class: `curve ${line.look}`, d }));
    }
    this.cursor = draw("line", { class: "cursor", y1: 0, y2: floor });
    this.svg.replaceChildren(...parts, this.cursor);
  }

  show(time) {
    const x = this.x(Math.min(time, this.drive.end));
    this.cursor.setAttribute("x1", x);
    this.cursor.setAttribute("x2", x);
    const texts = this.lines.map((line) => {
      const value = line.values[lastUpTo(line.times, time)];
      const number = value === null || value === undefined ? "–" : `${value.toFixed(this.unit === "m" ? 3 : 2)} ${this.unit}`.trim();
      return this.lines.length > 1 ? make("span", { class: `of ${line.look}` }, `${line.name} ${number}`) : number;
    });
    this.value.replaceChildren(...texts);
  }
}

/** Plots of a drive. */
function plotsOf(drive) {
  const found = [];
  if (drive.clearance) {
    found.push(new Plot(drive, "clearance", "m", [{ name: "", look: "one", times: drive.clearanceTimes, values: drive.clearance }], 0));
  }
  const lines = [{ name: "deviation", look: "one", times: drive.t, values: drive.deviation }];
  if (drive.delta.some((value) => value !== null)) lines.push({ name: "δ(v)", look: "two", times: drive.t, values: drive.delta });
  const last = drive.t[drive.deviation.findLastIndex((value) => value !== null)] ?? 0;
  const partly = drive.cycles.length === 1 && last < drive.end - 0.5; // a single plan is predicted for one cycle
  found.push(new Plot(drive, `deviation from the prediction${partly ? `, recorded for ${last.toFixed(1)} s` : ""}`, "m", lines, 0));
  found.push(new Plot(drive, "speed", "m/s", [{ name: "", look: "one", times: drive.t, values: drive.speed }]));
  for (const { name, range, values, unit } of drive.commands) {
    const plot = new Plot(drive, `command: ${name.replaceAll("_", " ")}`, unit.startsWith("share") ? "" : unit, [{ name: "", look: "one", times: drive.t, values }]);
    [plot.low, plot.high] = range;
    found.push(plot);
  }
  return found;
}
