(() => {
  const root = document.documentElement;
  const css = name => getComputedStyle(root).getPropertyValue(name).trim();
  const charts = () => [...document.querySelectorAll(".chart")].filter(e => e.data);
  const axis = () => ({ gridcolor: css("--grid"), linecolor: css("--line"), zerolinecolor: css("--line"), tickcolor: css("--line") });

  function themed(layout) {
    const flat = { "paper_bgcolor": "rgba(0,0,0,0)", "plot_bgcolor": "rgba(0,0,0,0)", "font.color": css("--ink"), "font.family": css("--sans"),
      "hoverlabel.bgcolor": css("--card"), "hoverlabel.bordercolor": css("--line"), "hoverlabel.font.color": css("--ink"),
      "hoverlabel.font.family": css("--sans"), "legend.bgcolor": "rgba(0,0,0,0)",
      "modebar.bgcolor": "rgba(0,0,0,0)", "modebar.color": css("--muted"), "modebar.activecolor": css("--accent") };
    for (const key of Object.keys(layout)) {
      if (/^[xy]axis\d*$/.test(key)) for (const [k, v] of Object.entries(axis())) flat[`${key}.${k}`] = v;
      if (/^scene\d*$/.test(key)) for (const a of ["xaxis", "yaxis", "zaxis"]) {
        for (const [k, v] of Object.entries(axis())) flat[`${key}.${a}.${k}`] = v;
        flat[`${key}.${a}.showbackground`] = false;
      }
    }
    return flat;
  }
  const repaint = () => charts().forEach(e => Plotly.relayout(e, themed(e.layout)));

  // plotly and large figures are packed: base64 of gzip
  async function text(id) {
    const element = document.getElementById(id);
    if (element.type !== "application/gzip") return element.textContent;
    const bytes = Uint8Array.from(atob(element.textContent), c => c.charCodeAt(0));
    return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
  }
  // "@n" stands for the n-th different array of numbers
  function whole(packed) {
    const known = [];
    return JSON.parse(packed, (key, value) => {
      if (key !== "bdata") return value;
      if (value[0] === "@") return known[Number(value.slice(1))];
      known.push(value);
      return value;
    });
  }
  async function draw(element) {
    const figure = whole(await text(element.id + "-data"));
    // a resize forgets the layout's height and takes the element's: a phone that is turned would flatten the figure
    if (figure.layout.height) element.style.height = figure.layout.height + "px";
    await Plotly.newPlot(element, figure.data, figure.layout,
      { responsive: true, displaylogo: false,
        modeBarButtons: [figure.layout.scene ? ["toImage", "orbitRotation", "pan3d", "resetCameraDefault3d"]
          : ["toImage", "zoom2d", "pan2d", "resetScale2d"]],
        toImageButtonOptions: { format: "svg", filename: element.id } });
    if (figure.frames) await Plotly.addFrames(element, figure.frames);
    await Plotly.relayout(element, themed(element.layout));
  }
  async function drawAll() {
    const places = [...document.querySelectorAll(".chart")];
    if (!places.length) return;
    if (typeof DecompressionStream === "undefined") {
      places.forEach(e => { e.textContent = "This browser is older than 2023 and cannot unpack the figures. The numbers are in the files beside this page."; });
      return;
    }
    const script = document.createElement("script");
    script.textContent = await text("plotly");
    document.head.append(script);
    for (const element of places) await draw(element);
  }
  drawAll();

  // a figure as a picture, or its numbers as a table: one row per point of each trace that is shown
  function table(chart) {
    const rows = [["trace", "x", "y", "z"]];
    for (const trace of chart._fullData) {
      if (trace.visible !== true || !trace.x) continue;
      for (let i = 0; i < trace.x.length; i++)
        rows.push([trace.name, trace.x[i], (trace.y || [])[i], (trace.z || [])[i]]);
    }
    const cell = value => /[",\n]/.test(value) ? `"${String(value).replaceAll('"', '""')}"` : value;
    return rows.map(row => row.map(value => cell(value ?? "")).join(",")).join("\n") + "\n";
  }
  document.querySelectorAll(".saves").forEach(saves => saves.addEventListener("click", event => {
    const format = event.target.dataset.format, chart = document.getElementById(saves.dataset.chart);
    if (!format) return;
    if (format !== "csv") {
      Plotly.downloadImage(chart, { format, filename: chart.id, width: chart.clientWidth, height: chart.clientHeight, scale: 2 });
      return;
    }
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([table(chart)], { type: "text/csv" }));
    link.download = chart.id + ".csv";
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  }));

  // a row of tabs shows one named group of a chart's traces, or one block of the page, at a time
  document.querySelectorAll(".tabs").forEach(tabs => tabs.addEventListener("click", event => {
    const button = event.target.closest("button");
    if (!button) return;
    tabs.querySelectorAll("button").forEach(b => b.setAttribute("aria-pressed", String(b === button)));
    (tabs.dataset.charts || "").split(" ").filter(Boolean).forEach(id => {
      const chart = document.getElementById(id);
      Plotly.restyle(chart, { visible: chart.data.map(t => !t.meta || t.meta === button.dataset.group) });
    });
    if (tabs.dataset.blocks) document.querySelectorAll("." + tabs.dataset.blocks)
      .forEach(b => { b.hidden = b.dataset.group !== button.dataset.group; });
  }));

  document.querySelectorAll("[data-toggle]").forEach(box => box.addEventListener("change", () =>
    document.querySelectorAll(".overlays").forEach(o => o.classList.toggle("hide-" + box.dataset.toggle, !box.checked))));

  const themeButton = document.getElementById("theme");
  if (themeButton) themeButton.addEventListener("click", () => {
    const dark = root.dataset.theme ? root.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
    root.dataset.theme = dark ? "light" : "dark";
    repaint();
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", repaint);
  let before;
  addEventListener("beforeprint", () => { before = root.dataset.theme; root.dataset.theme = "light"; repaint(); });
  addEventListener("afterprint", () => { if (before) root.dataset.theme = before; else delete root.dataset.theme; repaint(); });
})();
