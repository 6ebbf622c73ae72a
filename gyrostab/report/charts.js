// Draws the charts of a report and links them: one window and one axis are chosen in the whole page.
"use strict";
(() => {
  const json = (id) => JSON.parse(document.getElementById(id).textContent);
  // On a narrow page the bar of buttons would cover the legend; fingers and double clicks do as much.
  const narrow = matchMedia("(max-width: 600px)").matches;
  const options = { responsive: true, displaylogo: false, displayModeBar: narrow ? false : "hover" };
  // The colour scale above instead of at the side, and fewer labels, which would run into each other.
  const fitNarrowPage = ({ data, layout }) => {
    // Panels side by side move apart, so that their labels do not touch.
    const spread = (x) => (x < 0.5 ? 0.87 * x : 1 - 0.87 * (1 - x));
    for (const name of Object.keys(layout).filter((key) => key.startsWith("xaxis"))) {
      const [from, to] = layout[name].domain ?? [0, 1];
      const half = { nticks: 2, domain: [spread(from), spread(to)], tickfont: { size: 12 } };
      Object.assign(layout[name], { tickangle: 0 }, to - from < 0.6 ? half : { nticks: 3 });
    }
    const scales = [...data, layout.coloraxis ?? {}].filter((item) => item.colorbar);
    for (const { colorbar } of scales) {
      const title = { ...colorbar.title, side: "top" };
      Object.assign(colorbar, { title, orientation: "h", yref: "container", y: 1, yanchor: "top", thickness: 12 });
      layout.margin = { ...layout.margin, t: 90 };
    }
    for (const note of layout.annotations ?? []) {
      Object.assign(note, { font: { ...note.font, size: 12 }, x: spread(note.x) });
    }
  };
  const thinLogLabels = (chart) => {
    for (const [name, axis] of Object.entries(chart.layout)) {
      if (!name.startsWith("xaxis") || axis.type !== "log") continue;
      const decades = Math.abs(axis.range[1] - axis.range[0]);
      if (decades > 2) Plotly.relayout(chart, `${name}.dtick`, Math.ceil(decades / 6));
    }
  };
  const charts = {};
  for (const place of document.querySelectorAll(".chart")) {
    const figure = json(`figure-${place.id}`);
    charts[place.id] = place;
    if (narrow) fitNarrowPage(figure);
    const drawn = Plotly.newPlot(place, figure.data, figure.layout, options);
    if (narrow) drawn.then(thinLogLabels);
  }
  const source = document.getElementById("window-data");
  if (!source) return;

  const { axes, colours, times, tau, values } = JSON.parse(source.textContent);
  const decode = (text) =>
    new Float32Array(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);
  const surfaces = values.map((axis) =>
    Object.fromEntries(Object.entries(axis).map(([name, text]) => [name, decode(text)])));
  const slider = document.getElementById("window-slider");
  const label = document.getElementById("window-label");
  const select = document.getElementById("axis-select");
  let axis = 0;
  let window_ = Math.floor(times.length / 2);

  const row = (name) => {
    const all = surfaces[axis][name].subarray(window_ * tau.length, (window_ + 1) * tau.length);
    return Array.from(all, (value) => (value > 0 ? value : null));
  };
  const cursor = (chart) => {
    const shapes = (chart.layout.shapes || []).filter((shape) => shape.name !== "cursor");
    const at = times[window_];
    shapes.push({ name: "cursor", type: "line", xref: "x", yref: "paper", x0: at, x1: at,
      y0: 0, y1: 1, line: { color: "#D00000", width: 1.5 } });
    Plotly.relayout(chart, { shapes });
  };
  const showWindow = () => {
    slider.value = window_;
    label.textContent = `axis ${axes[axis]}, window centred on ${times[window_]} UTC`;
    slider.setAttribute("aria-valuetext", label.textContent);
    Plotly.restyle(charts.window,
      { y: [row("low"), row("high"), row("fitted"), row("measured")],
        "marker.color": colours[axis], fillcolor: colours[axis] + "33" });
    cursor(charts.map);
    cursor(charts.coefficients);
  };
  const showAxis = () => {
    const all = surfaces[axis].measured;
    const table = (change) => tau.map((_, k) => times.map((_, t) => {
      const value = all[t * tau.length + k];
      return value > 0 ? change(value) : null;
    }));
    const plain = table((value) => value);
    const logs = table(Math.log10);
    Plotly.restyle(charts.map, { z: [logs], customdata: [plain] });
    if (charts.surface) Plotly.restyle(charts.surface, { z: [plain], surfacecolor: [logs] });
    showWindow();
  };
  const choose = (number) => {
    if (number === window_ || number < 0 || number >= times.length) return;
    window_ = number;
    showWindow();
  };
  const stamps = times.map((text) => Date.parse(text.replace(" ", "T") + "Z"));
  const nearest = (text) => {
    const at = typeof text === "number" ? text : Date.parse(text.replace(" ", "T") + "Z");
    let best = 0;
    stamps.forEach((stamp, i) => {
      if (Math.abs(stamp - at) < Math.abs(stamps[best] - at)) best = i;
    });
    return best;
  };

  slider.max = times.length - 1;
  slider.addEventListener("input", () => choose(Number(slider.value)));
  select.addEventListener("change", () => { axis = Number(select.value); showAxis(); });
  for (const chart of [charts.map, charts.coefficients]) {
    chart.on("plotly_hover", (event) => choose(nearest(event.points[0].x)));
  }
  showAxis();
})();
