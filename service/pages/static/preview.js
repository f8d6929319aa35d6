// The channels of a recording in the form, and the part of it that is used.

import { draw } from './figures.js';
import { address } from './live.js';

const plot = document.querySelector('[data-preview]');
const field = (form, name) => form.elements.namedItem(name);
let loading = null;

/** Load Plotly when it is first needed: the list of jobs has no other plot. */
function loadPlotly() {
  loading ??= new Promise((done, failed) => {
    const script = document.createElement('script');
    script.src = plot.dataset.plotly;
    script.onload = done;
    script.onerror = failed;
    document.head.append(script);
  });
  return loading;
}

/** Draw the channels of a recording. A zoom along the time chooses the part that is used. */
export async function previewDataset(form, id) {
  for (const name of ['from', 'to']) field(form, name).value = '';
  document.getElementById('preview').hidden = false;
  plot.dataset.figure = 'signals';
  plot.dataset.url = address(`/v1/datasets/${encodeURIComponent(id)}/figures/signals`);
  await loadPlotly();
  await draw(plot);
  if (plot.dataset.followed) return;
  plot.dataset.followed = '1';
  plot.on('plotly_relayout', (change) => {
    const ends = [change['xaxis.range[0]'], change['xaxis.range[1]']];
    if (change['xaxis.autorange']) ends.fill(undefined);
    else if (ends[0] === undefined) return;
    ['from', 'to'].forEach((name, place) => (field(form, name).value = ends[place] === undefined ? '' : Number(ends[place].toPrecision(6))));
  });
}

export function forgetPreview(form) {
  for (const name of ['from', 'to']) field(form, name).value = '';
  document.getElementById('preview').hidden = true;
}

/** Read the part of the recording that is used; null for all of it. Other text is sent as typed. */
export function readRange(form) {
  const range = {};
  for (const [name, key] of [['from', 'start'], ['to', 'stop']]) {
    const text = field(form, name).value.trim();
    if (text) range[key] = Number.isNaN(Number(text)) ? text : Number(text);
  }
  return Object.keys(range).length ? range : null;
}
