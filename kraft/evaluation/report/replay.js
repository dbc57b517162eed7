// Replay of a trial: reads the texts that kraft/evaluation/replay.py writes, draws the drive and plays it.
// Units are m, s and rad; x is to the right and y up inside the group of the floor plan.

const SVG = "http://www.w3.org/2000/svg";
const TRAIL = 1.0; // time for which observations stay visible, s
const LEGEND = 204, GAP = 24; // widths of the legend beside the floor plan and between plan and plots, px
const ABOVE = 0.6; // share of the height that a floor plan above the plots has
const LOWEST = 88, HIGHEST = 180; // heights of a plot, px
const SCALES = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500]; // lengths that the bar of the legend may have, m
const LONGEST_SCALE = 80; // px

/** Make an SVG element; `attributes` are set as they are. */
function draw(tag, attributes = {}, ...children) {
  const found = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) found.setAttribute(name, value);
  found.append(...children);
  return found;
}

/** Make an HTML element with text or other content; all text is escaped. */
function make(tag, attributes = {}, ...children) {
  const found = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) found.setAttribute(name, value);
  found.append(...children);
  return found;
}

/** Content of a compressed text. */
async function unpacked(text) {
  const bytes = Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
  const plain = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Response(plain).json();
}

/** Numbers of a series [quantum, order, integers]. */
function valuesOf([quantum, order, integers]) {
  const found = integers.slice();
  for (let k = 0; k < order; k++) for (let i = 1; i < found.length; i++) found[i] += found[i - 1];
  return found.map((value) => value * quantum);
}

/** Rows of several series: [[x0, y0, ...], ...]. */
function rowsOf(columns) {
  const values = columns.map(valuesOf);
  return values[0].map((_, i) => values.map((column) => column[i]));
}

/** Index of the last number up to `value` in an ascending list; 0 before the first one. */
function lastUpTo(ascending, value) {
  let low = 0, high = ascending.length - 1;
  while (low < high) {
    const middle = (low + high + 1) >> 1;
    if (ascending[middle] <= value + 1e-9) low = middle; else high = middle - 1;
  }
  return low;
}

/** Linear interpolation of rows at `times`, constant outside. */
function at(times, rows, time) {
  const i = lastUpTo(times, time);
  if (i + 1 >= times.length || time <= times[i]) return rows[i];
  const share = (time - times[i]) / (times[i + 1] - times[i]);
  return rows[i].map((value, k) => value + share * (rows[i + 1][k] - value));
}

/** Corners of the footprint [offset, length, width] at a pose. */
function corners([offset, length, width], [x, y, theta]) {
  const c = Math.cos(theta), s = Math.sin(theta);
  return [[1, 1], [1, -1], [-1, -1], [-1, 1]].map(([a, b]) => {
    const along = offset + (a * length) / 2, across = (b * width) / 2;
    return [x + c * along - s * across, y + s * along + c * across];
  });
}

/** Path through points. */
function path(points, closed = false) {
  return points.length ? "M" + points.map(([x, y]) => `${x.toFixed(3)} ${y.toFixed(3)}`).join("L") + (closed ? "z" : "") : "";
}

/** Point of control of a smooth curve at `here` on the side of `after`; `here` itself at its ends and where it reverses. */
function control(before, here, after) {
  if (!before || !after) return here;
  const [ax, ay, bx, by] = [here[0] - before[0], here[1] - before[1], after[0] - here[0], after[1] - here[1]];
  if (ax * bx + ay * by <= 0) return here;
  // centripetal Catmull-Rom: the square roots of the distances are the parameters, so that no loop comes of unequal ones
  const a = Math.sqrt(Math.hypot(ax, ay)), b = Math.sqrt(Math.hypot(bx, by)), whole = 3 * a * (a + b);
  return here.map((value, k) => value + (a * a * (after[k] - value) + b * b * (value - before[k])) / whole);
}

/** Smooth curve through points, as vehicles drive between the samples of a plan. */
function curve(points) {
  const all = points.filter(([x, y], i) => i === 0 || x !== points[i - 1][0] || y !== points[i - 1][1]);
  if (all.length < 3) return path(all);
  const text = ([x, y]) => `${x.toFixed(3)} ${y.toFixed(3)}`;
  return `M${text(all[0])}` + all.slice(1).map((end, i) => {
    const first = control(all[i - 1], all[i], end), second = control(all[i + 2], end, all[i]);
    return `C${text(first)} ${text(second)} ${text(end)}`;
  }).join("");
}

/** Drive of a trial with its series as lists of numbers; `time` is the trial's (s), null if it has none. */
class Drive {
  constructor(content, time) {
    this.footprint = content.footprint;
    this.t = valuesOf(content.t);
    this.end = Math.max(this.t.at(-1), time ?? 0); // the trial goes on for a tick after the last sample
    this.pose = rowsOf(content.pose);
    this.speed = valuesOf(content.speed);
    const ahead = valuesOf(content.ahead), errors = rowsOf(content.error);
    this.estimateTimes = this.t.map((time, i) => time + ahead[i]);
    this.estimates = this.plus(this.estimateTimes, errors);
    this.commands = Object.entries(content.command).map(([name, { range, values, unit }]) =>
      ({ name, range, values: valuesOf(values), unit: unit ?? "" }));
    this.clearanceTimes = this.t.filter((_, i) => i % content.every === 0);
    this.clearance = content.clearance ? valuesOf(content.clearance) : null;
    this.seenTimes = valuesOf(content.seen[0]);
    this.seen = this.plus(this.seenTimes, rowsOf(content.seen.slice(1)));
    this.boxes = (content.boxes ?? []).map(rowsOf);
    this.cycles = content.cycles.map((cycle) => ({
      ...cycle,
      plan: rowsOf(cycle.plan),
      contingency: cycle.contingency ? rowsOf(cycle.contingency) : null,
      blocked: (cycle.blocked ?? []).map(rowsOf),
      predicted: rowsOf(cycle.predicted.pose),
      predictedTimes: cycle.predicted.pose[0][2].map((_, i, all) =>
        cycle.predicted.t[0] + ((cycle.predicted.t[1] - cycle.predicted.t[0]) * i) / (all.length - 1)),
      delta: cycle.predicted.delta ? valuesOf(cycle.predicted.delta) : null,
    }));
    this.cycleTimes = this.cycles.map((cycle) => cycle.t);
    this.compare();
  }

  /** True poses at times plus errors. */
  plus(times, errors) {
    return times.map((time, i) => at(this.t, this.pose, time).map((value, k) => value + errors[i][k]));
  }

  /** Deviation of the farthest corner from the prediction, and delta(v), at each tick; null where nothing is predicted. */
  compare() {
    this.deviation = [];
    this.delta = [];
    this.t.forEach((time, i) => {
      const cycle = this.cycles[lastUpTo(this.cycleTimes, time)];
      const inside = time >= cycle.t - 1e-9 && time <= cycle.predictedTimes.at(-1) + 1e-6;
      const expected = corners(this.footprint, at(cycle.predictedTimes, cycle.predicted, time));
      const off = corners(this.footprint, this.pose[i]).map(([x, y], k) => Math.hypot(x - expected[k][0], y - expected[k][1]));
      this.deviation.push(inside ? Math.max(...off) : null);
      this.delta.push(inside && cycle.delta ? at(cycle.predictedTimes, cycle.delta.map((d) => [d]), time)[0] : null);
    });
  }
}

/** Path of each cycle's tree through the points of its branches. */
function treePaths(trees) {
  return trees.map((tree) => {
    if (!tree) return "";
    const [quantum, dx, dy, parents] = tree, places = [];
    const place = (node) => {
      if (!places[node]) {
        const [x, y] = parents[node] < 0 ? [0, 0] : place(parents[node]);
        places[node] = [x + dx[node], y + dy[node]];
      }
      return places[node];
    };
    return parents.map((parent, node) => {
      if (parent < 0) return "";
      return path([place(parent), place(node)].map(([x, y]) => [x * quantum, y * quantum]));
    }).join("");
  });
}

/** The floor plan with the moving things of a drive. */
class Stage {
  constructor(parent, drive, plan, obstacle) {
    this.drive = drive;
    this.svg = plan ? plan.cloneNode(true) : this.emptyPlan();
    this.svg.setAttribute("role", "img");
    this.svg.setAttribute("aria-label", "floor plan with the car; the text beside it says what it does");
    this.ground = this.svg.querySelector("g");
    for (const hit of this.ground.querySelectorAll(".hit")) { // coloured are all that any trial hit
      if (!obstacle || !hit.textContent.startsWith(`${obstacle}: `)) hit.classList.remove("hit");
      hit.removeAttribute("style");
    }
    this.movable = [...this.ground.querySelectorAll(".movable")];
    for (const each of this.ground.querySelectorAll(".movable, .bump, .slippery, .uphill")) each.dataset.layer = "hidden";
    const add = (layer, tag = "path") => this.ground.appendChild(draw(tag, { "data-layer": layer, class: `live ${layer}` }));
    this.tree = add("tree");
    this.trail = add("car");
    this.trail.classList.add("trail");
    this.band = add("band", "g");
    this.sweep = this.band.appendChild(draw("path"));
    this.blocked = add("blocked");
    this.plan = add("plan");
    this.contingency = add("contingency");
    this.seen = add("seen");
    this.believed = add("believed");
    this.car = add("car");
    this.car.classList.add("body");
    this.nose = add("car");
    this.nose.classList.add("nose");
    parent.replaceChildren(this.svg);
  }

  emptyPlan() {
    let [x0, x1, y0, y1] = [Infinity, -Infinity, Infinity, -Infinity];
    for (const [x, y] of this.drive.pose) {
      [x0, x1, y0, y1] = [Math.min(x0, x - 1), Math.max(x1, x + 1), Math.min(y0, y - 1), Math.max(y1, y + 1)];
    }
    const place = `translate(${-x0} ${y1}) scale(1 -1)`;
    return draw("svg", { class: "floor", viewBox: `0 0 ${x1 - x0} ${y1 - y0}` }, draw("g", { transform: place }));
  }

  show(time, trees) {
    const drive = this.drive, footprint = drive.footprint;
    const k = lastUpTo(drive.cycleTimes, time), cycle = drive.cycles[k], now = at(drive.t, drive.pose, time);
    this.car.setAttribute("d", path(corners(footprint, now), true));
    const [offset, length, width] = footprint;
    const nose = [[length / 2, 0], [length / 4, width / 3], [length / 4, -width / 3]];
    const c = Math.cos(now[2]), s = Math.sin(now[2]);
    this.nose.setAttribute("d", path(nose.map(([a, b]) => [now[0] + c * (offset + a) - s * b, now[1] + s * (offset + a) + c * b]), true));
    this.believed.setAttribute("d", path(corners(footprint, at(drive.estimateTimes, drive.estimates, time)), true));
    this.trail.setAttribute("d", path([...drive.pose.slice(0, lastUpTo(drive.t, time) + 1), now]));
    const first = lastUpTo(drive.seenTimes, time - TRAIL), last = lastUpTo(drive.seenTimes, time);
    const seen = drive.seen.slice(first, last + 1).filter((_, i) => drive.seenTimes[first + i] <= time);
    this.seen.setAttribute("d", seen.map(([x, y]) => `M${x.toFixed(3)} ${y.toFixed(3)}h0`).join(""));
    if (cycle !== this.cycle || trees !== this.trees) this.showCycle(cycle, trees?.[k] ?? "");
    this.trees = trees;
    const i = lastUpTo(drive.t, time);
    this.movable.forEach((box, b) => {
      const poses = drive.boxes[b];
      if (!poses) return;
      const [x0, y0, yaw0] = poses[0], [x, y, yaw] = poses[i];
      box.setAttribute("transform", `translate(${x} ${y}) rotate(${((yaw - yaw0) * 180) / Math.PI}) translate(${-x0} ${-y0})`);
    });
  }

  showCycle(cycle, tree) {
    this.cycle = cycle;
    const stop = cycle.kind === "contingency";
    this.blocked.setAttribute("d", cycle.blocked.map((corners) => path(corners, true)).join(""));
    this.tree.setAttribute("d", tree);
    this.plan.setAttribute("d", stop ? "" : curve(cycle.plan));
    this.contingency.setAttribute("d", curve(stop ? cycle.plan : cycle.contingency ?? []));
    // One path per shape in a group with one opacity: the shapes overlap without getting darker.
    this.band.replaceChildren(...cycle.predicted.map((pose, i) => {
      const width = cycle.delta ? 2 * cycle.delta[i] : 0;
      return draw("path", { d: path(corners(this.drive.footprint, pose), true), "stroke-width": width.toFixed(3) });
    }));
  }
}

/** Dialog that plays a trial. `onMove(step)` goes to another trial of the list, `onClose()` back to the page. */
class Player {
  constructor(onMove, onClose) {
    const find = (name) => document.getElementById(`replay-${name}`);
    this.dialog = document.getElementById("replay");
    for (const name of ["title", "outcome", "problem", "cycle", "command", "play", "time", "clock", "speed"]) this[name] = find(name);
    this.drive = null;
    this.playing = false;
    this.trees = null;
    find("close").onclick = () => this.dialog.close();
    find("before").onclick = () => onMove(-1);
    find("after").onclick = () => onMove(1);
    find("link").onclick = (event) => this.copyLink(event.target);
    this.moves = [find("before"), find("after")];
    this.closing = find("close");
    find("back").onclick = () => this.step(-1);
    find("forward").onclick = () => this.step(1);
    this.play.onclick = () => this.setPlaying(!this.playing);
    this.time.oninput = () => this.seek(Number(this.time.value));
    this.dialog.addEventListener("close", () => { this.setPlaying(false); onClose(); });
    this.dialog.addEventListener("keydown", (event) => this.onKey(event, onMove));
    for (const box of this.dialog.querySelectorAll("input[data-layer]")) {
      box.onchange = () => this.dialog.classList.toggle(`without-${box.dataset.layer}`, !box.checked);
    }
    addEventListener("resize", () => { if (this.drive && this.dialog.open) this.fit(); });
  }

  onKey(event, onMove) {
    if (event.target === this.speed || event.ctrlKey || event.metaKey || event.altKey) return;
    const along = event.target === this.time && !event.shiftKey ? { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1 }[event.key] : 0;
    if (along) this.tick(along);
    else if (event.key === " ") {
      if (event.target.matches("button, input[type=checkbox]")) return; // the space bar presses what has the focus
      this.setPlaying(!this.playing);
    }
    else if (event.key === "ArrowLeft") { if (event.shiftKey) onMove(-1); else this.step(-1); }
    else if (event.key === "ArrowRight") { if (event.shiftKey) onMove(1); else this.step(1); }
    else return;
    event.preventDefault();
  }

  /** Copy the address of the trial; a browser may refuse that, but shows the address itself. */
  async copyLink(button) {
    let said = "copied";
    try { await navigator.clipboard.writeText(location.href); } catch { said = "refused: copy the browser's address"; }
    button.textContent = said;
    clearTimeout(this.saying);
    this.saying = setTimeout(() => { button.textContent = "copy link"; }, said === "copied" ? 1500 : 5000);
  }

  /** Open the dialog with the words of a trial; the drive follows with `load`. `first` and `last` are its places in the list. */
  open({ title, outcome, look, command, first = true, last = true }) {
    this.setPlaying(false);
    [this.moves[0].disabled, this.moves[1].disabled] = [first, last];
    this.drive = null;
    this.title.textContent = title;
    this.outcome.replaceChildren(make("i", { class: `swatch ${look}` }), ` ${outcome}`);
    this.command.replaceChildren(...(command ? ["drive it again: ", make("code", {}, command)] : []));
    this.problem.hidden = true;
    this.cycle.textContent = "";
    document.getElementById("stage").replaceChildren();
    document.getElementById("plots").replaceChildren();
    if (!this.dialog.open) this.dialog.showModal();
  }

  /** State why there is nothing to play. */
  refuse(text) {
    this.problem.textContent = text;
    this.problem.hidden = false;
    this.dialog.classList.add("empty");
    this.closing.focus(); // the controls are hidden, and keys need a focus inside of the dialog
  }

  /** Play a drive on a floor plan; `planning` are the planning times of its cycles (ms), `obstacle` is what it hit. */
  load(drive, plan, planning, obstacle) {
    this.dialog.classList.remove("empty");
    this.drive = drive;
    this.planning = planning;
    this.trees = null;
    this.stage = new Stage(document.getElementById("stage"), drive, plan, obstacle);
    this.showThings();
    this.plots = plotsOf(drive);
    const parent = document.getElementById("plots");
    parent.replaceChildren(...this.plots.map((plot) => plot.element));
    for (const plot of this.plots) {
      plot.svg.onpointerdown = (event) => { plot.svg.setPointerCapture(event.pointerId); this.seek(this.timeOf(plot, event)); };
      plot.svg.onpointermove = (event) => { if (event.buttons) this.seek(this.timeOf(plot, event)); };
    }
    this.time.max = drive.end.toFixed(2);
    this.fit();
    this.play.focus();
  }

  /** Leave out of the legend what floor plan and drive do not have. */
  showThings() {
    const svg = this.stage.svg;
    for (const entry of this.dialog.querySelectorAll("[data-thing]")) entry.hidden = !svg.querySelector(`.${entry.dataset.thing}`);
    const hidden = this.dialog.querySelector("[data-thing]:not([hidden])") === null;
    this.dialog.querySelector("input[data-layer=hidden]").parentElement.hidden = hidden;
    const blocked = this.drive.cycles.some((cycle) => cycle.blocked.length > 0);
    this.dialog.querySelector("input[data-layer=blocked]").parentElement.hidden = !blocked;
    document.getElementById("replay-hit").hidden = !svg.querySelector(".hit");
  }

  /** Show trees too. */
  loadTrees(trees) {
    this.trees = treePaths(trees);
    this.seek(this.now);
  }

  timeOf(plot, event) {
    const box = plot.svg.getBoundingClientRect();
    return plot.timeAt(((event.clientX - box.left) * plot.width) / box.width);
  }

  /** Fit plan and plots to the window. */
  fit() {
    this.fitPlan();
    this.renderPlots();
  }

  /** Place the floor plan where it is larger, above or beside the plots, in its own proportions; on a phone it is always above. */
  fitPlan() {
    const { width, height } = this.stage.svg.viewBox.baseVal, room = this.dialog.querySelector(".player");
    this.dialog.classList.toggle("landscape", width > 1.25 * height);
    const plots = Math.max(360, 0.38 * room.clientWidth), across = room.clientWidth - LEGEND;
    const beside = Math.min((across - plots - GAP) / width, room.clientHeight / height);
    const above = Math.min(across / width, (ABOVE * room.clientHeight) / height);
    this.dialog.classList.toggle("above", above > beside);
    const scale = Math.max(above, beside);
    this.dialog.style.setProperty("--plan-width", `${Math.floor(scale * width)}px`);
    this.dialog.style.setProperty("--plan-height", `${Math.floor(scale * height)}px`);
    this.showScale();
  }

  /** A bar in the legend as long as a round length is in the floor plan. */
  showScale() {
    const [bar, words] = document.getElementById("replay-scale").children;
    const pixels = this.stage.ground.getScreenCTM().a; // of a metre
    const length = SCALES.findLast((each) => each * pixels <= LONGEST_SCALE) ?? SCALES[0];
    bar.style.width = `${(length * pixels).toFixed(1)}px`;
    words.textContent = `${length} m`;
  }

  /** Draw the plots, as high as their panel leaves room for. */
  renderPlots() {
    const panel = this.dialog.querySelector(".panel");
    const draw = (height) => {
      for (const plot of this.plots) {
        plot.width = Math.max(240, plot.element.clientWidth);
        plot.render(plot.width, height);
      }
    };
    draw(LOWEST);
    this.seek(this.now ?? 0); // the words about the cycle take room, too
    const used = this.command.getBoundingClientRect().bottom - panel.getBoundingClientRect().top + panel.scrollTop;
    const rows = new Set(this.plots.map((plot) => plot.element.offsetTop)).size;
    const height = Math.min(HIGHEST, LOWEST + Math.floor((panel.clientHeight - used - GAP) / rows));
    if (height > LOWEST) draw(height);
    for (const plot of this.plots) plot.show(this.now);
  }

  /** Go to a time. */
  seek(time) {
    if (!this.drive) return;
    this.now = Math.min(Math.max(time, 0), this.drive.end);
    const k = lastUpTo(this.drive.cycleTimes, this.now);
    this.stage.show(this.now, this.trees);
    for (const plot of this.plots) plot.show(this.now);
    this.time.value = this.now;
    const clock = `${this.now.toFixed(2)} of ${this.drive.end.toFixed(2)} s`;
    this.clock.textContent = clock;
    this.time.setAttribute("aria-valuetext", `${clock}, cycle ${k + 1} of ${this.drive.cycles.length}`);
    if (this.shownCycle !== this.drive.cycles[k]) this.showCycle(k);
  }

  showCycle(k) {
    const cycle = this.shownCycle = this.drive.cycles[k];
    const words = [`Cycle ${k + 1} of ${this.drive.cycles.length}: `, make("b", { class: cycle.kind }, cycle.kind)];
    if (cycle.origin) words.push(` (${cycle.origin})`);
    if (cycle.sent === false) words.push(", its message was lost");
    words.push(cycle.reason ? `: ${cycle.reason}. ` : ". ");
    if (cycle.cost !== undefined) words.push(`${cycle.cost.toFixed(1)} s to the goal. `);
    if (cycle.blocked.length > 0) words.push(`${cycle.blocked.length} assumed obstacle${cycle.blocked.length > 1 ? "s" : ""} where the car was blocked. `);
    const planned = this.planning[k] === undefined ? "" : `${this.planning[k].toFixed(0)} ms`;
    if (cycle.iterations > 0) words.push(`${cycle.nodes} nodes after ${cycle.iterations} iterations${planned && ` in ${planned}`}.`);
    else if (planned) words.push(`Planned in ${planned}.`);
    this.cycle.replaceChildren(...words);
  }

  /** Go to the beginning of the cycle before or after. */
  step(count) {
    if (!this.drive) return;
    this.setPlaying(false);
    const times = this.drive.cycleTimes, k = lastUpTo(times, this.now);
    const back = this.now > times[k] + 0.02 ? k : k - 1;
    const to = count < 0 ? back : k + 1;
    this.seek(to >= times.length ? this.drive.end : times[Math.max(0, to)]);
  }

  /** Go to the tick of the controller before or after. */
  tick(count) {
    if (!this.drive) return;
    this.setPlaying(false);
    const times = this.drive.t, k = lastUpTo(times, this.now);
    const to = count < 0 && this.now > times[k] + 1e-6 ? k : k + count;
    this.seek(to >= times.length ? this.drive.end : times[Math.max(0, to)]);
  }

  setPlaying(playing) {
    this.playing = playing && this.drive !== null;
    this.play.textContent = this.playing ? "pause" : "play";
    if (!this.playing) return;
    if (this.now >= this.drive.end - 1e-6) this.seek(0);
    let before = performance.now();
    const drive = this.drive;
    const frame = (now) => {
      if (!this.playing || this.drive !== drive) return;
      this.seek(this.now + ((now - before) / 1000) * Number(this.speed.value));
      before = now;
      if (this.now >= drive.end) this.setPlaying(false);
      else requestAnimationFrame(frame);
    };
    requestAnimationFrame(frame);
  }
}
