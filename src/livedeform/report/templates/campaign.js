(() => {
  const { columns, earliest, rows } = JSON.parse(document.getElementById("campaign-data").textContent);
  const at = Object.fromEntries(columns.map((c, i) => [c.name, i])), KEY = columns.length, LINKS = KEY + 1;
  const WIDTH = { recording: 190, phantom: 120, rig: 80, status: 80, run_verdict: 80, verdict: 120, coverage: 105, error_before_m: 105, effects: 420, rivals: 150, problem: 240 };
  const width = c => WIDTH[c.name] ?? (c.kind === "time" ? 150 : 95);
  const css = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const TONE = { status: { done: "neutral", failed: "bad" }, run_verdict: { OK: "good", ERROR: "bad", STALE: "bad" }, verdict: { none: "good", unexplained: "bad" } };
  const REPORTS = { run_verdict: [1, "run"], verdict: [2, "diagnosis"] };  // bit of the row's links, and the folder
  const tone = row => row[at.status] === "failed" || row[at.run_verdict] === "ERROR" ? "bad"
    : row[at.verdict] + row[at.run_verdict] !== "" && ["", "none"].includes(row[at.verdict]) && ["", "OK"].includes(row[at.run_verdict]) ? "good" : "warn";
  const time = s => s === "" ? "" : s < earliest ? "clock not set" : new Date(1000 * s).toISOString().replace("T", " ").slice(0, 19);
  const make = (tag, name, text = "") => { const e = document.createElement(tag); e.className = name; e.textContent = text; return e; };

  // what is shown: row numbers, filtered and sorted
  const words = rows.map(r => r.slice(0, KEY).join(" ").toLowerCase());
  let shown = rows.map((_, i) => i), by = at.recording, down = false, chosen = -1;
  const search = document.getElementById("search"), picks = document.getElementById("picks"), picked = {};
  function compare(i, j) {
    const a = rows[i][by], b = rows[j][by];
    if (a === b) return i - j;
    if (a === "" || b === "") return a === "" ? 1 : -1;  // what is missing comes last, either way
    return (a < b ? -1 : 1) * (down ? -1 : 1);
  }
  function update() {
    const asked = search.value.toLowerCase().split(/\s+/).filter(w => w && w !== "-");
    const must = asked.filter(w => w[0] !== "-"), not = asked.filter(w => w[0] === "-").map(w => w.slice(1));
    const exact = Object.entries(picked).filter(([, v]) => v !== "");
    shown = [];
    for (let i = 0; i < rows.length; i++)
      if (exact.every(([c, v]) => rows[i][c] === v) && must.every(w => words[i].includes(w)) && !not.some(w => words[i].includes(w))) shown.push(i);
    shown.sort(compare);
    document.getElementById("shown").textContent = `${shown.length} of ${rows.length}`;
    table.place.scrollTop = 0;
    table.renew(shown.length);
    order();
  }
  for (const name of ["phantom", "rig", "status", "run_verdict", "verdict"]) {
    const values = [...new Set(rows.map(r => r[at[name]]))].filter(v => v !== "").sort();
    if (values.length < 2) continue;
    const select = make("select", "");
    select.dataset.column = name;
    select.append(new Option(`${columns[at[name]].heading}: all`, ""), ...values.map(v => new Option(v, v)));
    select.onchange = () => { picked[at[name]] = select.value; update(); };
    picks.append(select);
  }

  // a list of which only the part in sight is in the document
  function windowed(place, height, draw) {
    const filler = place.querySelector(".filler");
    let n = 0, first = -1, last = -1;
    function paint() {
      const from = Math.max(0, Math.floor(place.scrollTop / height) - 8);
      const to = Math.min(n, Math.ceil((place.scrollTop + place.clientHeight) / height) + 8);
      if (from === first && to === last) return;
      [first, last] = [from, to];
      const part = [];
      for (let i = from; i < to; i++) { const e = draw(i); e.style.top = `${i * height}px`; part.push(e); }
      filler.replaceChildren(...part);
      filler.dispatchEvent(new Event("painted"));
    }
    place.addEventListener("scroll", () => requestAnimationFrame(paint));
    return { place, paint, renew(count) { n = count; first = last = -1; filler.style.height = `${n * height}px`; paint(); } };
  }

  function cell(row, c, i) {
    const value = c.kind === "time" ? time(row[i]) : c.kind === "text" || row[i] === "" ? row[i] : row[i].toFixed(c.kind === "mm" ? 3 : 1);
    const e = make("span", `cell ${c.kind === "text" || c.kind === "time" ? "" : "number"}`);
    e.style.width = `${width(c)}px`;
    if (TONE[c.name]) {
      const [bit, folder] = REPORTS[c.name] ?? [0, ""], linked = row[LINKS] & bit;
      const pill = make(linked ? "a" : "span", `pill ${TONE[c.name][value] ?? "warn"}`, value);
      if (linked) { pill.href = `jobs/${row[KEY]}/${folder}/report.html`; pill.title = `report of the ${folder}`; }
      if (value) e.append(pill);
    }
    else e.textContent = e.title = value;
    return e;
  }
  const LINE = 28;
  const table = windowed(document.getElementById("rows"), LINE, n => {
    const row = rows[shown[n]], e = make("div", `line ${shown[n] === chosen ? "chosen" : ""}`);
    if (row[at.problem]) {  // it has no numbers: its line stands in their place, in sight
      const problem = make("span", "cell problem", row[at.problem]);
      problem.title = row[at.problem];
      e.append(...columns.slice(0, at.run_verdict).map((c, i) => cell(row, c, i)), problem);
    } else e.append(...columns.map((c, i) => cell(row, c, i)));
    return e;
  });
  columns.forEach((c, i) => {
    const b = make("button", c.kind === "text" ? "" : "number", c.heading);
    b.type = "button"; b.style.width = `${width(c)}px`; b.style.flex = "none"; b.dataset.column = c.name;
    b.onclick = () => {
      [down, by] = [by === i && !down, i];
      for (const other of b.parentElement.children) other.textContent = other.textContent.replace(/ [▲▼]$/, "");
      b.textContent += down ? " ▼" : " ▲";
      update();
    };
    document.getElementById("heads").append(b);
  });

  // timelines: one strip per phantom that is shown
  let strips = [];
  const STRIP = 45;
  const lines = windowed(document.getElementById("timelines"), STRIP, n => {
    const [phantom, members] = strips[n], e = make("div", "strip"), canvas = document.createElement("canvas");
    e.append(make("b", "", phantom), canvas);
    canvas.members = members;
    return e;
  });
  function order() {
    const of = new Map();
    for (const i of shown) if (rows[i][at.started_ns] !== "") {
      const p = rows[i][at.phantom];
      if (!of.has(p)) of.set(p, []);
      of.get(p).push(i);
    }
    strips = [...of].sort((a, b) => a[0] < b[0] ? -1 : 1);
    lines.renew(strips.length);
  }
  document.querySelector("#timelines .filler").addEventListener("painted", () => document.querySelectorAll("#timelines canvas").forEach(paintStrip));
  function mark(g, tone, x, y) {  // told apart without colours
    g.beginPath();
    if (tone === "good") g.arc(x, y, 4, 0, 7);
    else if (tone === "bad") g.rect(x - 4, y - 4, 8, 8);
    else { g.moveTo(x, y - 5); g.lineTo(x + 5, y + 4); g.lineTo(x - 5, y + 4); }
    g.fill();
  }
  function paintStrip(canvas) {
    const w = canvas.width = canvas.clientWidth, h = canvas.height = 42, g = canvas.getContext("2d");
    const times = canvas.members.map(i => rows[i][at.started_ns]), low = Math.min(...times), span = Math.max(...times) - low;
    const spread = low < earliest || span === 0, n = times.length;
    const along = k => spread ? (k + 0.5) / n : (times[k] - low) / span;
    const known = i => rows[i][at.error_before_m] || rows[i][at.rmse_m], error = i => known(i) || 0, top = Math.max(...canvas.members.map(error)) || 1;
    canvas.places = canvas.members.map((i, k) => [10 + (w - 20) * along(k), h - 6 - (h - 14) * error(i) / top]);
    canvas.members.forEach((i, k) => {
      const [x, y] = canvas.places[k], after = rows[i][at.error_after_m];
      g.fillStyle = g.strokeStyle = css(`--${tone(rows[i])}`);
      if (known(i)) mark(g, tone(rows[i]), x, y); else g.fillText("?", x - 3, y);  // no error is not the least one
      if (after !== "") { const z = h - 6 - (h - 14) * after / top; g.beginPath(); g.moveTo(x, y); g.lineTo(x, z); g.moveTo(x - 4, z); g.lineTo(x + 4, z); g.stroke(); }
    });
  }
  document.getElementById("timelines").addEventListener("click", event => {
    const canvas = event.target;
    if (!canvas.places) return;
    const distance = canvas.places.map(([x, y]) => Math.hypot(x - event.offsetX, y - event.offsetY));
    chosen = canvas.members[distance.indexOf(Math.min(...distance))];
    table.place.scrollTop = shown.indexOf(chosen) * LINE;
    table.renew(shown.length);
  });
  search.oninput = update;
  addEventListener("resize", () => { table.paint(); document.querySelectorAll("#timelines canvas").forEach(paintStrip); });
  update();
})();
