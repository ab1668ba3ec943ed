"use strict";
const figures = JSON.parse(document.getElementById("figures").textContent);
const dark = window.matchMedia("(prefers-color-scheme: dark)");

// Plotly knows no CSS: the page's colours reach it as a template.
function template() {
  const style = getComputedStyle(document.documentElement);
  const colour = (name) => style.getPropertyValue(name).trim();
  const axis = {
    gridcolor: colour("--line"), zerolinecolor: colour("--line"), linecolor: colour("--line"),
    color: colour("--quiet"), automargin: true,
  };
  const space = { ...axis, showbackground: false };
  return {
    layout: {
      paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
      font: { color: colour("--ink"), family: getComputedStyle(document.body).fontFamily, size: 12 },
      xaxis: axis, yaxis: axis, scene: { xaxis: space, yaxis: space, zaxis: space },
      showlegend: false, margin: { l: 50, r: 10, t: 10, b: 40 },
      hoverlabel: { bgcolor: colour("--paper"), font: { color: colour("--ink") } },
    },
  };
}

// The camera's angle of view is that of the height: a narrow page would cut the sides off.
function stepBack(layout, width) {
  const eye = layout.scene.camera.eye;
  for (const axis of "xyz") eye[axis] *= layout.height / width;
}

const options = { responsive: true, displaylogo: false, displayModeBar: false };
const places = document.querySelectorAll(".plot");
for (const place of places) {
  const { data, layout } = figures[place.dataset.figure];
  if (layout.scene && place.clientWidth < layout.height) stepBack(layout, place.clientWidth);
  Plotly.newPlot(place, data, { ...layout, template: template() }, options);
}
dark.addEventListener("change", () => {
  for (const place of places) Plotly.relayout(place, { template: template() });
});

// Groups of traces that take turns in the figure behind the buttons.
for (const button of document.querySelectorAll(".switch button")) {
  button.addEventListener("click", () => {
    const row = button.parentNode, place = row.nextElementSibling;
    const visible = place.data.map((trace) => String(trace.meta) === button.value);
    for (const other of row.children) other.setAttribute("aria-pressed", other === button);
    Plotly.restyle(place, { visible });
  });
}

function sortBy(table, column, head) {
  const up = head.getAttribute("aria-sort") === "descending";
  for (const other of head.parentNode.children) other.removeAttribute("aria-sort");
  head.setAttribute("aria-sort", up ? "ascending" : "descending");
  const key = (row) => row.cells[column].dataset.key ?? row.cells[column].textContent;
  const sign = up ? 1 : -1;
  const rows = [...table.tBodies[0].rows];
  rows.sort((a, b) => sign * key(a).localeCompare(key(b), "en", { numeric: true }));
  const numbers = rows.every((row) => row.cells[column].dataset.key !== undefined);
  if (numbers) rows.sort((a, b) => sign * (key(a) - key(b)));
  table.tBodies[0].append(...rows);
}

for (const table of document.querySelectorAll(".sortable table")) {
  [...table.tHead.rows[0].cells].forEach((head, column) => {
    head.addEventListener("click", () => sortBy(table, column, head));
  });
}
