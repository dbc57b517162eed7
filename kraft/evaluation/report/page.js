// The page: list of trials with filters, tables that sort, hints at hidden columns, and links to trials (#trial=...).

const data = JSON.parse(document.getElementById("data").textContent);
const LISTED = 30; // trials that are listed until more are asked for

const trials = data.trials.map(([number, entry, method, seed, outcome, obstacle, text, time, clearance, contingencies, cause, why, stored, planning, command]) => ({
  number, seed, outcome, obstacle, text, time, clearance, contingencies, cause, why, stored, planning, command,
  entry: data.entries[entry], method: data.methods[method],
}));
const key = (trial) => [trial.entry.name, trial.method.name, trial.seed].map(encodeURIComponent).join("/");
/** Decoded text of a part of an address; the text itself if it is no code. */
function decoded(text) {
  try { return decodeURIComponent(text); } catch { return text; }
}
/** Trial of the parts entry/method/seed of an address, however they are coded; undefined without. */
const trialOf = (address) => byKey.get(address.split("/").map(decoded).map(encodeURIComponent).join("/"));
const byKey = new Map(trials.map((trial) => [key(trial), trial]));

/* ---- list of trials ---- */

const columns = [
  { name: "entry", of: (trial) => trial.entry.name },
  { name: "method", of: (trial) => trial.method.title },
  { name: "seed", of: (trial) => trial.seed, number: true },
  { name: "outcome", of: (trial) => trial.outcome, cell: (trial) => [make("i", { class: `swatch ${trial.outcome}` }), ` ${trial.text}`] },
  { name: "time, s", short: "time", of: (trial) => trial.time, number: true, digits: 2 },
  { name: "clearance, m", short: "clear", of: (trial) => trial.clearance, number: true, digits: 3 },
  { name: "contingencies", short: "cont", of: (trial) => trial.contingencies, number: true },
  { name: "cause", of: (trial) => trial.cause, cell: (trial) => [trial.cause ?? "", make("small", {}, trial.why ?? "")] },
];
const filters = ["outcome", "method", "cause", "entry"];
const list = { sort: null, descending: false, shown: LISTED, found: trials };

function listed() {
  const wanted = filters.map((name) => [name, document.getElementById(`filter-${name}`).value]).filter(([, value]) => value);
  const has = { outcome: (t) => t.outcome, method: (t) => t.method.name, cause: (t) => t.cause, entry: (t) => t.entry.name };
  const matches = (trial, name, value) => (value === "not success" ? trial.outcome !== "success" : has[name](trial) === value);
  const found = trials.filter((trial) => wanted.every(([name, value]) => matches(trial, name, value)));
  if (list.sort) {
    const sign = list.descending ? -1 : 1, of = list.sort.of;
    found.sort((a, b) => compared(of(a), of(b), sign) || a.number - b.number);
  }
  return found;
}

/** Order of two values, descending if `sign` is -1; missing ones are last. */
function compared(a, b, sign) {
  if (a === b) return 0;
  if (a === null || a === undefined) return 1;
  if (b === null || b === undefined) return -1;
  return sign * (typeof a === "number" ? a - b : String(a).localeCompare(String(b), "en", { numeric: true }));
}

function showList() {
  list.found = listed();
  const rows = list.found.slice(0, list.shown).map((trial) => {
    const cells = columns.map((column) => {
      const value = column.of(trial);
      const text = column.digits === undefined || value === null ? value ?? "–" : value.toFixed(column.digits);
      const content = column.cell ? column.cell(trial) : [String(text)];
      return make("td", column.number ? { class: "number", "data-label": column.short ?? column.name } : {}, ...content);
    });
    cells[0].replaceChildren(make("a", { href: `#trial=${key(trial)}` }, trial.entry.name));
    return make("tr", {}, ...cells);
  });
  document.querySelector("#trials tbody").replaceChildren(...rows);
  const count = list.found.length, plural = (n) => `${n.toLocaleString("en")} trial${n === 1 ? "" : "s"}`;
  document.getElementById("trials-count").textContent =
    count === trials.length ? plural(count) : `${plural(count)} of ${trials.length.toLocaleString("en")}`;
  const more = document.getElementById("trials-more");
  more.hidden = count <= list.shown;
  const others = count - list.shown;
  more.textContent = others > 10 * LISTED ? `show ${10 * LISTED} more of ${others}` : others === 1 ? "show the other one" : `show all ${others} others`;
  showHints();
}

function setUpList() {
  const options = {
    outcome: [["not success", "not success"], ...["success", "collision", "timeout", "failed"].map((name) => [name, name])],
    method: data.methods.map((method) => [method.name, method.title]),
    cause: [...new Set(trials.map((trial) => trial.cause).filter(Boolean))].sort().map((name) => [name, name]),
    entry: data.entries.map((entry) => [entry.name, entry.name]),
  };
  for (const name of filters) {
    const select = document.getElementById(`filter-${name}`);
    select.append(...options[name].map(([value, text]) => make("option", { value }, text)));
    select.onchange = () => { list.shown = LISTED; writeFilters(); showList(); };
  }
  const heading = document.querySelector("#trials thead tr");
  heading.append(...columns.map((column) => {
    const button = make("button", { type: "button" }, column.name);
    const cell = make("th", column.number ? { class: "number" } : {}, button);
    button.onclick = () => {
      list.descending = list.sort === column && !list.descending;
      list.sort = column;
      for (const other of heading.children) other.removeAttribute("aria-sort");
      cell.setAttribute("aria-sort", list.descending ? "descending" : "ascending");
      showList();
    };
    return cell;
  }));
  document.getElementById("trials-more").onclick = () => { list.shown += 10 * LISTED; showList(); };
}

/** Take the filters of an address such as #show&method=kraft&outcome=collision. */
function readFilters(hash) {
  const wanted = new URLSearchParams(hash.slice("show".length));
  const missing = [];
  for (const name of filters) {
    const select = document.getElementById(`filter-${name}`), value = wanted.get(name) ?? "";
    select.value = value;
    if (select.selectedIndex >= 0) continue;
    select.value = "";
    missing.push(`${name} ${value}`);
  }
  list.shown = LISTED;
  showList();
  say(missing.length ? `No trial here has the ${missing.join(", the ")}: the list is not filtered by it.` : "");
}

/** Scroll to the list and move the focus there, so that the keyboard and screen readers continue at it. */
function showTrials() {
  const heading = document.querySelector("#trials h2");
  heading.tabIndex = -1;
  heading.focus({ preventScroll: true });
  document.getElementById("trials").scrollIntoView();
}

/** Show a message above the list; none if it is empty. */
function say(text) {
  const alarm = document.getElementById("trials-alarm");
  alarm.textContent = text;
  alarm.hidden = !text;
}

function writeFilters() {
  say("");
  const chosen = new URLSearchParams();
  for (const name of filters) {
    const value = document.getElementById(`filter-${name}`).value;
    if (value) chosen.set(name, value);
  }
  history.replaceState(null, "", chosen.size ? `#show&${chosen}` : "#trials");
}

/* ---- tables that sort by a column, and hints at columns that do not fit ---- */

/** Let the headings of a table sort the rows of each of its bodies: totals stay where they are. */
function sortable(table) {
  const heading = table.querySelector("thead tr");
  [...heading.children].forEach((cell, k) => {
    const button = make("button", { type: "button", title: "sort by this column" }, ...cell.childNodes);
    cell.replaceChildren(button);
    button.onclick = () => {
      const descending = cell.getAttribute("aria-sort") === "ascending";
      for (const other of heading.children) other.removeAttribute("aria-sort");
      cell.setAttribute("aria-sort", descending ? "descending" : "ascending");
      const value = (row) => {
        const found = row.children[k].dataset.value;
        return found === undefined ? row.children[k].textContent : found === "" ? null : Number(found);
      };
      for (const body of table.tBodies) {
        body.append(...[...body.rows].sort((a, b) => compared(value(a), value(b), descending ? -1 : 1)));
      }
    };
  });
}

/** Leave out all but the numbers of an overview that does not fit otherwise. */
function narrowOverview() {
  for (const table of document.querySelectorAll(".overview")) {
    table.classList.remove("narrow");
    const box = table.parentElement;
    table.classList.toggle("narrow", box.clientWidth > 0 && box.scrollWidth > box.clientWidth + 1);
  }
}

function showHints() {
  for (const box of document.querySelectorAll(".wide")) {
    const hidden = box.scrollWidth - box.clientWidth - box.scrollLeft;
    let hint = box.previousElementSibling;
    if (!hint?.classList.contains("more-columns")) {
      hint = make("button", { type: "button", class: "more-columns" });
      hint.onclick = () => box.scrollBy({ left: 0.8 * box.clientWidth, behavior: "smooth" });
      box.before(hint);
      box.addEventListener("scroll", showHints, { passive: true });
    }
    const edge = box.getBoundingClientRect().right;
    const beyond = [...box.querySelectorAll("tr:first-child > th")].filter((cell) => cell.getBoundingClientRect().right > edge + 2);
    hint.hidden = hidden < 2 || box.clientWidth === 0;
    hint.textContent = beyond.length ? `${beyond.length} more column${beyond.length === 1 ? "" : "s"} →` : "more →";
    if (box.scrollWidth > box.clientWidth + 1) box.tabIndex = 0; else box.removeAttribute("tabindex");
  }
}

/* ---- replays ---- */

/** Text of a part of a replay: from the page, else from the server of the folder. */
async function stored(trial, part) {
  const inside = document.getElementById(`${part}:${trial.number}`);
  if (inside) return inside.textContent;
  if (!data.served) return null;
  const answer = await fetch(`replay/${part}/${key(trial)}`);
  if (answer.status === 404) return null;
  if (!answer.ok) throw new Error(`the server answers ${answer.status} ${answer.statusText}`);
  return answer.text();
}

/** Trial that is `step` places after another: in the list as it is, if that has the other one; undefined at its ends. */
function besides(trial, step) {
  const all = list.found.includes(trial) ? list.found : trials;
  return trial ? all[all.indexOf(trial) + step] : undefined;
}

let before = ""; // address to go back to when the replay is closed

const player = new Player(
  (step) => {
    const next = besides(player.trial, step);
    if (next) location.replace(`#trial=${key(next)}`);
  },
  () => { if (location.hash.startsWith("#trial=")) history.pushState(null, "", before || location.pathname + location.search); },
);

async function openTrial(trial) {
  player.trial = trial;
  const cause = trial.cause ? `. Cause: ${trial.cause}; ${trial.why}` : "";
  player.open({
    title: `${trial.entry.name}, ${trial.method.title}, seed ${trial.seed}`,
    outcome: `${trial.text}${trial.time === null ? "" : ` after ${trial.time.toFixed(2)} s`}${cause}`,
    look: trial.outcome, command: trial.command, first: !besides(trial, -1), last: !besides(trial, 1),
  });
  try {
    const text = await stored(trial, "drive");
    if (player.trial !== trial) return;
    if (text === null) { player.refuse(trial.stored ? data.elsewhere : data.unrecorded); return; }
    const drive = new Drive(await unpacked(text), trial.time);
    if (player.trial !== trial) return;
    player.now = 0;
    player.load(drive, document.querySelector(`[data-entry="${CSS.escape(trial.entry.slug)}"] svg.floor`), trial.planning, trial.obstacle);
    const trees = await stored(trial, "trees"), grown = trees === null ? null : await unpacked(trees);
    if (grown !== null && player.drive === drive) player.loadTrees(grown);
  } catch (error) {
    if (player.trial === trial) player.refuse(`The replay cannot be read: ${error.message}`);
  }
}

function route() {
  const hash = location.hash.slice(1);
  if (hash.startsWith("trial=")) {
    const address = hash.slice("trial=".length), trial = trialOf(address);
    if (trial) openTrial(trial);
    else {
      player.trial = null;
      player.open({ title: "No such trial", outcome: decoded(address), look: "missing" });
      player.refuse("The link is of a trial that this evaluation does not have, or has not run yet.");
    }
    return;
  }
  before = location.hash;
  if (player.dialog.open) player.dialog.close();
  if (hash.startsWith("show")) {
    readFilters(hash);
    showTrials();
    return;
  }
  const target = document.getElementById(decoded(hash)), entry = target?.closest("details.entry");
  if (entry && !entry.open) { entry.open = true; target.scrollIntoView(); } // browsers open it only when a link is followed
}

setUpList();
document.querySelectorAll("table.sortable").forEach(sortable);
narrowOverview();
showList();
addEventListener("hashchange", route);
addEventListener("click", (event) => { // an address that the page has already is no change of it
  const link = event.target.closest?.('a[href^="#show"]');
  if (link && link.hash === location.hash) route();
});
addEventListener("resize", () => { narrowOverview(); showHints(); });
addEventListener("toggle", showHints, true);
addEventListener("beforeprint", () => { for (const each of document.querySelectorAll("details.entry")) each.open = true; });
route();
