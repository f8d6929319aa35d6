// New identification: choices from the REST interface, live checks, and one POST to /v1/jobs.

import { Problem, ask, element, latest } from './live.js';
import * as forms from './fields.js';
import { clearFaults, fillTable, overrides, showFaults } from './fields.js';

const panel = document.getElementById('new');
const form = document.getElementById('job-form');
const field = (name) => form.elements.namedItem(name);
const state = { dataset: null, model: null, cloned: null, extra: {}, started: false };
const query = new URLSearchParams(location.search);

async function start() {
  if (state.started) return;
  state.started = true;
  form.inert = true; // what was typed or sent before all is there would be lost, or lack what is taken over
  try {
    await fill();
  } finally {
    form.inert = false;
  }
}

async function fill() {
  const [datasets, models] = await Promise.all([ask('/v1/datasets?limit=200'), ask('/v1/models')]);
  for (const one of datasets.items) {
    field('dataset').append(new Option(one.name, one.id));
    field('validation').append(new Option(`recording ${one.name}`, one.id));
  }
  for (const one of models.items) field('model').append(new Option(one.title ? `${one.name} – ${one.title}` : one.name, one.name));
  if (query.get('clone')) await fillFrom(query.get('clone'));
  else {
    if (query.get('dataset')) await choose(query.get('dataset'));
    await listed();
  }
}

/** Take over the request of an earlier job; what the form has no field for goes along. */
async function fillFrom(job) {
  const { request, name } = await ask(`/v1/jobs/${encodeURIComponent(job)}`);
  const set = (key, value) => value !== undefined && value !== null && (field(key).value = value);
  state.extra = request;
  set('name', name);
  const algorithm = request.algorithm ?? {};
  for (const key of ['method', 'population', 'generations']) set(key, algorithm[key]);
  if (Number.isInteger(algorithm.islands)) set('islands', algorithm.islands);
  set('evaluations', algorithm.stop?.evaluations);
  for (const key of ['seed', 'prediction']) set(key, request[key]);
  set('loss', request.loss?.kind);
  set('noise_model', request.loss?.noise_model);
  const fraction = request.validation?.fraction;
  if (fraction) {
    const known = [...field('validation').options].some((one) => one.value === String(fraction));
    if (!known) field('validation').append(new Option(`the last ${100 * fraction} %`, String(fraction)));
    set('validation', String(fraction));
  } else if (request.validation) {
    field('validation').append(new Option('as in the cloned job', 'clone'));
    set('validation', 'clone');
  }
  await choose(request.datasets[0]);
  if (typeof request.model === 'string') {
    set('model', request.model);
    await listed(request.parameters);
  } else {
    field('source').value = 'own';
    const text = await ask(`/pages/jobs/${encodeURIComponent(job)}/model.yaml`);
    state.cloned = { text, model: request.model };
    await own(text, request.parameters);
  }
  mapChannels(request.channels, request.hold);
}

async function choose(id) {
  if (![...field('dataset').options].some((one) => one.value === id)) {
    const found = await ask(`/v1/datasets/${encodeURIComponent(id)}`);
    field('dataset').append(new Option(found.name, found.id));
  }
  field('dataset').value = id;
  await chosen();
}

const recordingOf = latest(async (id) => ({ dataset: id ? await ask(`/v1/datasets/${encodeURIComponent(id)}`) : null }));

async function chosen() {
  const found = await recordingOf(field('dataset').value);
  if (!found) return;
  state.dataset = found.dataset;
  const facts = document.getElementById('dataset-facts');
  const channels = state.dataset?.channels ?? [];
  facts.textContent = channels.map((one) => (one.unit && one.unit !== '1' ? `${one.name} [${one.unit}]` : one.name)).join(' · ');
  mapChannels();
}

async function upload() {
  const [file] = field('upload').files;
  if (!file) return;
  clearFaults(form);
  say(`storing ${file.name}…`);
  const type = file.name.toLowerCase().endsWith('.mcap') ? 'application/x-mcap' : 'text/csv';
  try {
    const stored = await ask(`/v1/datasets?name=${encodeURIComponent(file.name)}`, {
      method: 'POST', headers: { 'Content-Type': type }, body: file,
    });
    await choose(stored.id);
    say(`${file.name} is stored`);
  } catch (error) {
    if (!(error instanceof Problem)) throw error;
    form.querySelector('[data-fault="/datasets"]').textContent = error.message;
    say('');
  }
}

/** A model of the list, or the check of a text: only what was asked for last is shown. */
const about = latest((question) => question());

/** Show a model of the list; its text is there to be read, and to be changed with "own equations". */
async function listed(changes) {
  const name = encodeURIComponent(field('model').value);
  const found = await about(() => Promise.all([ask(`/v1/models/${name}`), ask(`/pages/models/${name}.yaml`)]));
  if (!found) return;
  const [model, text] = found;
  field('equations').value = text;
  field('equations').readOnly = true;
  take(model.document, changes);
  verdict({ valid: true });
}

async function own(text, changes) {
  if (text !== undefined) field('equations').value = text;
  field('equations').readOnly = false;
  await check(changes);
}

/** Whether the text can be used; null where something else was asked for meanwhile. */
async function check(changes) {
  const text = field('equations').value;
  const found = await about(() =>
    ask('/v1/models:check', { method: 'POST', headers: { 'Content-Type': 'application/yaml' }, body: text }));
  if (!found) return null;
  verdict(found);
  if (found.valid) take(found.normal_form, changes);
  return found.valid;
}

function verdict(found) {
  const place = document.getElementById('check');
  field('equations').ariaInvalid = String(!found.valid);
  if (found.valid) return place.replaceChildren(element('span', 'the model is valid', 'status identified'));
  const list = document.createElement('ul');
  for (const one of found.errors) {
    const where = [one.pointer, one.column && `column ${one.column}`].filter(Boolean).join(', ');
    const item = element('li', '', 'fault');
    item.append(element('b', where), ` ${one.detail}`);
    list.append(item);
  }
  place.replaceChildren(element('span', 'the model is not valid yet', 'fault'), list);
}

function take(document, changes) {
  const same = JSON.stringify(state.model) === JSON.stringify(document);
  state.model = document;
  if (same && !changes) return;
  fillTable(document, changes ?? overrides());
  mapChannels();
}

/** One choice per signal of the model; an equal name is taken, else the one at the same place. */
function mapChannels(wanted = {}, held = holds()) {
  if (!state.model || !state.dataset) return;
  const recorded = state.dataset.channels.map((one) => one.name);
  const inputs = Object.keys(state.model.inputs ?? {});
  const outputs = Object.keys(state.model.outputs ?? (state.model.output ? { [state.model.output]: 0 } : {}));
  const before = channels();
  const choices = [...inputs, ...outputs].map((signal, place) => {
    const label = element('label', inputs.includes(signal) ? `input ${signal}` : `output ${signal}`);
    const select = document.createElement('select');
    select.dataset.signal = signal;
    select.dataset.pointer = `/channels/${signal}`;
    recorded.forEach((name) => select.append(new Option(name, name)));
    const guess = [wanted[signal], before[signal], signal].find((name) => recorded.includes(name));
    select.value = guess ?? recorded[Math.min(place, recorded.length - 1)];
    label.append(select);
    return label;
  });
  document.getElementById('channels').replaceChildren(...choices, ...inputs.map((signal) => betweenSamples(signal, held[signal])));
}

/** What an input does between its samples; read wrongly, it moves a lag by half a sample. */
function betweenSamples(signal, hold) {
  const label = element('label', `${signal} between samples`);
  const select = document.createElement('select');
  select.dataset.hold = signal;
  select.dataset.pointer = `/hold/${signal}`;
  select.append(document.getElementById('holds').content.cloneNode(true));
  select.value = hold ?? '';
  label.append(select);
  return label;
}

/** The inputs for which something else is chosen than what the recording says. */
const holds = () =>
  Object.fromEntries([...form.querySelectorAll('[data-hold]')].filter((one) => one.value).map((one) => [one.dataset.hold, one.value]));

const channels = () =>
  Object.fromEntries([...form.querySelectorAll('[data-signal]')].map((one) => [one.dataset.signal, one.value]));

/** A number as typed; text that is none goes to the server, which says what would be right. */
const number = (name) => {
  const text = field(name).value.trim();
  return text === '' ? null : Number.isNaN(Number(text)) ? text : Number(text);
};

const isOwn = () => field('source').value === 'own';
/** A cloned document that was not changed goes out as it was; any other in its normal form. */
const ownModel = () => (field('equations').value === state.cloned?.text ? state.cloned.model : state.model);

function body() {
  const { sweep, ...kept } = state.extra;
  const algorithm = { ...kept.algorithm, method: field('method').value };
  for (const key of ['population', 'generations']) if (number(key) !== null) algorithm[key] = number(key);
  if (!Array.isArray(kept.algorithm?.islands) || number('islands') !== null) algorithm.islands = number('islands');
  algorithm.stop = { ...kept.algorithm?.stop, evaluations: number('evaluations') };
  const validation = field('validation').value;
  const datasets = kept.datasets?.[0] === field('dataset').value ? kept.datasets : [field('dataset').value];
  return {
    ...kept,
    ...(sweep?.axes?.length ? { sweep } : {}),
    name: field('name').value.trim() || null,
    model: isOwn() ? ownModel() : field('model').value,
    datasets: datasets.filter(Boolean),
    channels: channels(),
    hold: holds(),
    validation: validation === 'clone' ? kept.validation : chosenValidation(validation),
    parameters: overrides(),
    prediction: field('prediction').value,
    loss: { ...kept.loss, kind: field('loss').value, noise_model: field('noise_model').value },
    algorithm,
    seed: number('seed') ?? 1,
  };
}

/** None, the last part of the recording, or another recording. */
function chosenValidation(value) {
  if (!value) return null;
  return value.startsWith('ds_') ? { datasets: [value] } : { fraction: Number(value) };
}

/** Own equations are checked before they are sent. */
async function isReady() {
  while (isOwn()) {
    const usable = await check();
    if (usable) return true;
    if (usable === null) continue;
    say('the model is not valid yet');
    field('equations').focus();
    return false;
  }
  return true;
}

const say = (text) => forms.say(form, text);
const shown = (work) => forms.shown(form, work);

function delayed(work, ms) {
  let timer = 0;
  return () => {
    clearTimeout(timer);
    timer = setTimeout(work, ms);
  };
}

function open() {
  if (location.hash === '#new') panel.open = true;
}

field('dataset').addEventListener('change', shown(chosen));
field('upload').addEventListener('change', shown(upload));
field('model').addEventListener('change', shown(() => {
  field('source').value = 'listed';
  // What was typed into the table of the model before would be lost.
  state.model = null;
  fillTable({}, {});
  return listed();
}));
for (const one of field('source'))
  one.addEventListener('change', shown(() => (isOwn() ? own() : listed())));
field('equations').addEventListener('input', () => {
  about(async () => null); // an answer about the text before this one says nothing any more
  document.getElementById('check').replaceChildren(element('span', 'checking…', 'muted'));
});
field('equations').addEventListener('input', delayed(shown(() => check()), 300));
forms.submits(form, '/v1/jobs', body, isReady);
panel.addEventListener('toggle', shown(() => panel.open && start()));
addEventListener('hashchange', open);
open();
if (panel.open) shown(start)();
