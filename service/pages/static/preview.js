// The channels of a recording in the form, and the part of it that is used.

import { draw } from './figures.js';
import { parseNumber } from './fields.js';
import { address, makeElement } from './live.js';

const plot = document.querySelector('[data-preview]');
const detrended = document.getElementById('detrended');
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
export async function previewDataset(form, { id, channels }) {
  clear(form);
  document.getElementById('preview').hidden = false;
  detrended.replaceChildren(...channels.map(({ name }) => makeTick(name)));
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
  clear(form);
  document.getElementById('preview').hidden = true;
}

function clear(form) {
  for (const name of ['from', 'to', 'detrend']) field(form, name).value = '';
  detrended.hidden = true;
}

/** Make the tick of a channel from which the mean or line is subtracted. */
function makeTick(name) {
  const label = makeElement('label', '', 'inline');
  const box = Object.assign(document.createElement('input'), { type: 'checkbox', name: 'detrended', value: name, checked: true });
  label.append(box, name);
  return label;
}

document.addEventListener('change', ({ target }) => {
  if (target.name === 'detrend') detrended.hidden = !target.value;
});

/** Read how the recording is prepared, as steps of a derivation: its part, and what is subtracted. */
export function readSteps(form) {
  const range = readRange(form);
  const kind = field(form, 'detrend').value;
  const channels = [...detrended.querySelectorAll(':checked')].map((box) => box.value);
  return [...(range ? [{ trim: range }] : []), ...(kind ? [{ detrend: { kind, channels } }] : [])];
}

/** Read what is subtracted from validation data: the means of the prepared part, or their own lines. */
export function listValidationSteps(part) {
  const step = part.details.steps.find(({ detrend }) => detrend);
  if (!step) return [];
  const means = Object.fromEntries(part.details.subtracted.map(({ channel, value }) => [channel, value]));
  return [step.detrend.kind === 'mean' ? { offset: means } : step];
}

/** Read the part of the recording that is used; null for all of it. Other text is sent as typed. */
function readRange(form) {
  const range = {};
  for (const [name, key] of [['from', 'start'], ['to', 'stop']]) {
    const value = parseNumber(field(form, name).value);
    if (value !== null) range[key] = value;
  }
  return Object.keys(range).length ? range : null;
}
