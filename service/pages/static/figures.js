// Draws the figures that the server defines, once they are on the screen or on paper.

import { Problem, ask, askAtOnce, makeElement, post } from './live.js';

const dark = matchMedia('(prefers-color-scheme: dark)');
const CONFIG = {
  displaylogo: false,
  responsive: true,
  modeBarButtonsToRemove: ['lasso2d', 'select2d', 'autoScale2d', 'toImage', 'sendChartToCloud'], // nothing leaves this service
};
const isDark = () => dark.matches && !document.body.classList.contains('printing'); // paper is white
const seen = new WeakSet();
const latest = new WeakMap();

export const listPlots = () => [...document.querySelectorAll('[data-figure]')];

/** Build the address of a plot's figure, with what the user chose. */
function buildAddress(plot, extra = {}) {
  const url = new URL(plot.dataset.url, location.href);
  const query = new URLSearchParams([...url.searchParams, ...new URLSearchParams(plot.dataset.query ?? '')]);
  query.set('theme', isDark() ? 'dark' : 'light');
  if (['convergence', 'posterior', 'residuals', 'summary', 'trend'].includes(plot.dataset.figure)) query.set('columns', countColumns(plot));
  for (const [name, value] of Object.entries(extra)) query.set(name, value);
  url.search = query;
  return url;
}

const countColumns = (plot) => (plot.clientWidth < 520 ? 1 : plot.clientWidth < 860 ? 2 : 3);

/** Fetch and draw one plot. A figure is dropped if a later one was requested. */
export async function draw(plot, extra = {}) {
  const request = (latest.get(plot) ?? 0) + 1;
  latest.set(plot, request);
  try {
    const figure = await ask(buildAddress(plot, extra));
    if (latest.get(plot) !== request) return;
    await show(plot, figure);
  } catch (error) {
    if (!(error instanceof Problem)) throw error;
    if (latest.get(plot) === request && !plot.classList.contains('js-plotly-plot')) showMessage(plot, error.message);
  }
}

/** Show a figure in its plot. All but the promise is done at once. */
function show(plot, figure) {
  if (!figure.data.length) {
    if (!document.querySelector('[data-live="chip"][data-open="1"]')) plot.style.height = ''; // no figure will follow
    return showMessage(plot, plot.dataset.empty ?? 'nothing to show yet');
  }
  plot.querySelector('.plot-empty')?.remove();
  plot.style.height = `${figure.layout.height}px`;
  const first = !plot.classList.contains('js-plotly-plot');
  const drawn = window.Plotly.react(plot, figure.data, figure.layout, CONFIG);
  plot.dataset.thinned = figure.layout.meta?.thinned ?? '';
  plot.dispatchEvent(new CustomEvent('drawn', { bubbles: true, detail: figure.layout }));
  if (first) {
    plot.on('plotly_relayout', (change) => onZoom(plot, change));
    offerImages(plot);
  }
  return drawn;
}

/** Offer a drawn plot as SVG and as PNG, beside its CSV. */
function offerImages(plot) {
  const tools = plot.closest('section')?.querySelector('.tools');
  for (const format of tools ? ['svg', 'png'] : []) {
    const button = makeElement('button', format.toUpperCase(), 'link');
    button.type = 'button';
    button.ariaLabel = `${plot.ariaLabel} as ${format.toUpperCase()}`;
    button.addEventListener('click', () => window.Plotly.downloadImage(plot, {
      format, filename: plot.dataset.figure, width: plot.clientWidth, height: plot.clientHeight, scale: format === 'png' ? 2 : 1,
    }));
    tools.append(button);
  }
}

/** Draw every plot in light colours for the width of a sheet. A browser that prints waits for no promise. */
function drawForPaper() {
  document.body.classList.add('printing');
  let template;
  for (const plot of listPlots()) {
    const figure = askAtOnce(buildAddress(plot));
    if (!figure) continue;
    markSeen(plot);
    show(plot, figure);
    template = figure.layout.template;
  }
  for (const plot of listDrawn()) {
    const shown = plot.layout.template;
    window.Plotly.relayout(plot, { autosize: true, template: template ?? shown });
    addEventListener('afterprint', () => window.Plotly.relayout(plot, { autosize: true, template: shown }), { once: true });
  }
}

/** List what is drawn, also plots without an address, which were computed on request. */
const listDrawn = () => [...document.querySelectorAll('.js-plotly-plot')];

/** Request the profiles of a run, and draw them. */
export async function drawProfiles(button) {
  const plot = button.closest('section').querySelector('[data-profile-plot]');
  const url = `${button.dataset.profile}?theme=${isDark() ? 'dark' : 'light'}`;
  button.disabled = true;
  showMessage(plot, '…');
  try {
    const { figure } = await post(url, {});
    plot.querySelector('.plot-empty')?.remove();
    plot.style.height = `${figure.layout.height}px`;
    await window.Plotly.react(plot, figure.data, figure.layout, CONFIG);
  } catch (error) {
    if (!(error instanceof Problem)) throw error;
    showMessage(plot, error.message);
    button.disabled = false;
  }
}

function showMessage(plot, text) {
  const place = plot.querySelector('.plot-empty') ?? plot.appendChild(makeElement('span', '', 'plot-empty'));
  place.textContent = text;
}

/** Fetch the visible part of a thinned signal again, with more of its samples. */
function onZoom(plot, change) {
  if (!['response', 'disturbances', 'signals'].includes(plot.dataset.figure)) return;
  if (change['xaxis.autorange']) {
    if (plot.dataset.zoomed) draw(plot);
    delete plot.dataset.zoomed;
  } else if (change['xaxis.range[0]'] !== undefined && (plot.dataset.thinned === 'true' || plot.dataset.zoomed)) {
    plot.dataset.zoomed = '1';
    draw(plot, { start: change['xaxis.range[0]'], stop: change['xaxis.range[1]'] });
  }
}

/** Change a plot's query (its abscissa, its experiment) and draw it again. */
export function setQuery(plot, name, value) {
  const query = new URLSearchParams(plot.dataset.query ?? '');
  query.set(name, value);
  plot.dataset.query = query;
  const csv = document.querySelector(`[data-csv="${plot.dataset.figure}"]`);
  if (csv) {
    const url = new URL(csv.href);
    url.searchParams.set(name, value);
    csv.href = url;
  }
  if (seen.has(plot)) draw(plot);
}

/** Draw the plots again that are or were on the screen. */
export const redraw = (names) =>
  Promise.all(listPlots().filter((p) => seen.has(p) && (!names || names.includes(p.dataset.figure))).map((p) => draw(p)));

const watcher = new IntersectionObserver(
  (entries) => {
    for (const { target, isIntersecting } of entries) {
      if (!isIntersecting || seen.has(target)) continue;
      markSeen(target);
      draw(target);
    }
  },
  { rootMargin: '300px' },
);

function markSeen(plot) {
  seen.add(plot);
  watcher.unobserve(plot);
}

/** Draw every plot once it is on the screen, including plots added since. */
export function watch() {
  for (const plot of listPlots()) if (!seen.has(plot)) watcher.observe(plot);
}

// The figure lists its experiments.
document.addEventListener('drawn', ({ target, detail }) => {
  const names = detail.meta?.experiments ?? [];
  const choice = document.querySelector(`[data-experiment="${target.dataset.figure}"]`);
  if (!choice || names.length < 2 || choice.options.length) return;
  names.forEach((name, place) => choice.append(new Option(`${place + 1} · ${name}`, place)));
  choice.parentElement.hidden = false;
});
document.addEventListener('change', ({ target }) => {
  const name = target.dataset.experiment;
  if (name) setQuery(listPlots().find((p) => p.dataset.figure === name), 'experiment', target.value);
});

addEventListener('beforeprint', drawForPaper);
addEventListener('afterprint', () => {
  document.body.classList.remove('printing');
  redraw();
});

export function start() {
  watch();
  dark.addEventListener('change', () => redraw());
}
