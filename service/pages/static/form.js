// New identification: choices from the REST interface, live checks, and one POST to /v1/jobs.

import { Problem, address, ask, makeElement, keepLatest, post } from './live.js';
import * as forms from './fields.js';
import { clearFaults, fillAlgorithm, fillTable, parseNumber, readAlgorithm, readOverrides, showProposals } from './fields.js';
import { forgetPreview, listValidationSteps, previewDataset, readSteps } from './preview.js';
import { describeModel } from './equations.js';

const panel = document.getElementById('new');
const form = document.getElementById('job-form');
const field = (name) => form.elements.namedItem(name);
const state = { dataset: null, model: null, cloned: null, extra: {}, part: null, validation: null };
const query = new URLSearchParams(location.search);
const USUAL_MODEL = 'fopdt';

let filling = null;

/** Load the choices once. The form is inert until they are there, because they replace what was typed. */
function start() {
  form.inert ||= !filling;
  filling ??= fill().finally(() => (form.inert = false));
  return filling;
}

async function fill() {
  const [datasets, models] = await Promise.all([ask(address('/v1/datasets?limit=200')), ask(address('/v1/models'))]);
  for (const { name, id } of datasets.items) {
    field('dataset').append(new Option(name, id));
    field('validation').append(new Option(`recording ${name}`, id));
  }
  for (const { name, title } of models.items) field('model').append(new Option(title ? `${name} – ${title}` : name, name));
  if (query.get('clone')) await fillFrom(query.get('clone'));
  else {
    field('model').value = query.get('fit') ?? USUAL_MODEL;
    if (!field('model').value) field('model').selectedIndex = 0;
    if (query.get('dataset')) await selectDataset(query.get('dataset'));
    await showListedModel();
  }
}

/** Fill the form from an earlier job. Settings without a field are sent unchanged. */
async function fillFrom(job) {
  const { request, name } = await ask(address(`/v1/jobs/${encodeURIComponent(job)}`));
  const set = (key, value) => value !== undefined && value !== null && (field(key).value = value);
  state.extra = request;
  if (request.name) set('name', name); // the service names the other jobs after model and data
  fillAlgorithm(form, request.algorithm);
  for (const key of ['seed', 'prediction']) set(key, request[key]);
  set('loss', request.loss?.kind);
  set('noise_model', request.loss?.noise_model);
  if (request.posterior) set('posterior', 'sampled');
  const fraction = request.validation?.fraction;
  if (fraction) {
    const isListed = [...field('validation').options].some((option) => option.value === String(fraction));
    if (!isListed) field('validation').append(new Option(`the last ${100 * fraction} %`, String(fraction)));
    set('validation', String(fraction));
  } else if (request.validation) {
    field('validation').append(new Option('as in the cloned job', 'clone'));
    set('validation', 'clone');
  }
  await selectDataset(request.datasets[0]);
  if (typeof request.model === 'string') {
    set('model', request.model);
    await showListedModel(request.parameters);
  } else {
    field('source').value = 'own';
    const text = await ask(address(`/pages/jobs/${encodeURIComponent(job)}/model.yaml`));
    state.cloned = { text, model: request.model };
    await showOwnModel(text, request.parameters);
  }
  mapChannels(request.channels, request.hold);
}

async function selectDataset(id) {
  if (![...field('dataset').options].some((option) => option.value === id)) {
    const dataset = await ask(address(`/v1/datasets/${encodeURIComponent(id)}`));
    field('dataset').append(new Option(dataset.name, dataset.id));
  }
  field('dataset').value = id;
  await showDataset();
}

const fetchDataset = keepLatest(async (id) => ({ dataset: id ? await ask(address(`/v1/datasets/${encodeURIComponent(id)}`)) : null }));

async function showDataset() {
  const answer = await fetchDataset(field('dataset').value);
  if (!answer) return;
  state.dataset = answer.dataset;
  const facts = document.getElementById('dataset-facts');
  const channels = state.dataset?.channels ?? [];
  if (state.dataset) previewDataset(form, state.dataset);
  else forgetPreview(form);
  facts.textContent = channels.map(({ name, unit }) => (unit && unit !== '1' ? `${name} [${unit}]` : name)).join(' · ');
  mapChannels();
}

/** Store a file. Only the answer to the last choice of a recording is used. */
const storeFile = keepLatest((question) => question());

const showUpload = (text) => (document.getElementById('upload-state').textContent = text);

/** Forget the upload that is not answered yet, and what the form says of an earlier one. */
function dropUpload() {
  storeFile(async () => null);
  showUpload('');
  form.querySelector('[data-fault="/datasets"]').textContent = '';
}

async function upload() {
  const [file] = field('upload').files;
  if (!file) return;
  clearFaults(form);
  showUpload(`storing ${file.name}…`);
  try {
    const options = new URLSearchParams({ name: file.name });
    const period = readNumber('upload-period');
    if (period !== null) options.set('sample_time', period);
    const columns = field('upload-columns').value.trim();
    if (columns) options.set('columns', columns);
    const stored = await storeFile(() => ask(address(`/v1/datasets?${options}`), {
      method: 'POST', headers: { 'Content-Type': 'application/octet-stream' }, body: file,
    }));
    if (!stored) return;
    await selectDataset(stored.id);
    showUpload([`${file.name} is stored`, ...stored.warnings].join(' · '));
  } catch (error) {
    if (!(error instanceof Problem)) throw error;
    const message = error.message.replace(/\bsample_time\b/g, 'the field "sampling period"');
    form.querySelector('[data-fault="/datasets"]').textContent = askForColumns(message);
    showUpload('');
  }
}

/** Ask for names of columns, with those that the message proposes; return the message for the page. */
function askForColumns(message) {
  const proposal = /\bcolumns=([^\s.…]*[^\s.…,])/.exec(message);
  if (!proposal) return message;
  field('upload-columns').value = proposal[1];
  field('upload-columns').focus();
  return message.replace('columns=', 'the field "names of its columns": ');
}

/** Ask for a model of the list or for the check of a text. Only the last answer is shown. */
const askModel = keepLatest((question) => question());

/** Show a model of the list. Its text becomes editable with "own equations". */
async function showListedModel(changes) {
  const name = encodeURIComponent(field('model').value);
  const answers = await askModel(() => Promise.all([ask(address(`/v1/models/${name}`)), ask(address(`/pages/models/${name}.yaml`))]));
  if (!answers) return;
  const [model, text] = answers;
  field('equations').value = text;
  field('equations').readOnly = true;
  document.getElementById('yaml').open = false;
  applyModel(model.document, model.equations, changes);
  showVerdict({ valid: true });
}

async function showOwnModel(text, changes) {
  if (text !== undefined) field('equations').value = text;
  field('equations').readOnly = false;
  document.getElementById('yaml').open = true;
  await checkModel(changes);
}

/** Return whether the text is valid; null if another model was requested meanwhile. */
async function checkModel(changes) {
  const text = field('equations').value;
  const result = await askModel(() =>
    ask(address('/v1/models:check'), { method: 'POST', headers: { 'Content-Type': 'application/yaml' }, body: text }));
  if (!result) return null;
  showVerdict(result);
  if (result.valid) applyModel(result.normal_form, result.equations, changes);
  return result.valid;
}

function showVerdict(result) {
  const place = document.getElementById('check');
  field('equations').ariaInvalid = String(!result.valid);
  document.getElementById('about-model').classList.toggle('outdated', !result.valid);
  const list = document.createElement('ul');
  for (const fault of (result.valid ? result.warnings : result.errors) ?? []) {
    const where = [fault.pointer, fault.column && `column ${fault.column}`].filter(Boolean).join(', ');
    const item = makeElement('li', '', result.valid ? '' : 'fault');
    item.append(makeElement('b', where), ` ${fault.detail}`);
    list.append(item);
  }
  const verdict = result.valid ? ['the model is valid', 'status identified'] : ['the model is not valid yet', 'fault'];
  place.replaceChildren(makeElement('span', ...verdict), ...(list.children.length ? [list] : []));
}

function applyModel(model, equations, changes) {
  const same = JSON.stringify(state.model) === JSON.stringify(model);
  state.model = model;
  if (same && !changes) return;
  describeModel(model, equations);
  fillTable(model, changes ?? readOverrides());
  mapChannels();
}

/** Show in the empty field how the service will name the job. A batch is named after its label. */
function showDefaultName() {
  if (state.model && state.dataset && !state.extra.trend) field('name').placeholder = `${state.model.name} on ${state.dataset.name}`;
}

/** Draw one choice per signal of the model: the channel of the same name, else of the same place. */
function mapChannels(wanted = {}, held = readHolds()) {
  showDefaultName();
  if (!state.model || !state.dataset) return;
  const recorded = state.dataset.channels.map((channel) => channel.name);
  const inputs = Object.keys(state.model.inputs ?? {});
  const outputs = Object.keys(state.model.outputs ?? (state.model.output ? { [state.model.output]: 0 } : {}));
  const before = readChannels();
  const choices = [...inputs, ...outputs].map((signal, place) => {
    const label = makeElement('label', inputs.includes(signal) ? `input ${signal}` : `output ${signal}`);
    const select = document.createElement('select');
    select.dataset.signal = signal;
    select.dataset.pointer = `/channels/${signal}`;
    recorded.forEach((name) => select.append(new Option(name, name)));
    const guess = [wanted[signal], before[signal], signal].find((name) => recorded.includes(name));
    select.value = guess ?? recorded[Math.min(place, recorded.length - 1)];
    label.append(select);
    return label;
  });
  document.getElementById('channels').replaceChildren(...choices, ...[...inputs, ...outputs].map((signal) => {
    const template = inputs.includes(signal) ? 'holds' : 'output-holds';
    return makeHoldChoice(signal, held[signal], template);
  }));
  proposeBounds();
}

const fetchBounds = keepLatest((url) => ask(url));

/** Show the bounds that a listed model takes from the chosen channels. */
async function proposeBounds() {
  if (isOwn() || !state.dataset) return;
  const url = new URL(address(`/pages/datasets/${encodeURIComponent(state.dataset.id)}/bounds`));
  url.searchParams.set('model', field('model').value);
  for (const [signal, name] of Object.entries(readChannels())) url.searchParams.append('channel', `${signal}=${name}`);
  const proposals = await fetchBounds(url).catch(() => null); // the submission tells what does not fit
  if (proposals) showProposals(proposals);
}

/** Make the choice of a signal's hold. A wrong hold moves a time lag by half a sample. */
function makeHoldChoice(signal, hold, template) {
  const label = makeElement('label', `${signal} between samples`);
  const select = document.createElement('select');
  select.dataset.hold = signal;
  select.dataset.pointer = `/hold/${signal}`;
  select.append(document.getElementById(template).content.cloneNode(true));
  select.value = hold ?? '';
  label.append(select);
  return label;
}

/** Read the holds that were chosen. Other signals have the hold of the recording. */
const readHolds = () =>
  Object.fromEntries([...form.querySelectorAll('[data-hold]')].filter((select) => select.value).map((select) => [select.dataset.hold, select.value]));

const readChannels = () =>
  Object.fromEntries([...form.querySelectorAll('[data-signal]')].map((select) => [select.dataset.signal, select.value]));

const readNumber = (name) => parseNumber(field(name).value);

const isOwn = () => field('source').value === 'own';
/** Return the own model. An unchanged cloned document is sent as it was, others in normal form. */
const getOwnModel = () => (field('equations').value === state.cloned?.text ? state.cloned.model : state.model);

function buildBody() {
  const { sweep, ...extra } = state.extra;
  const validation = field('validation').value;
  const datasets = extra.datasets?.[0] === field('dataset').value ? extra.datasets : [field('dataset').value];
  return {
    ...extra,
    ...(sweep?.axes?.length ? { sweep } : {}),
    name: field('name').value.trim() || null,
    model: isOwn() ? getOwnModel() : field('model').value,
    datasets: state.part ? [state.part] : datasets.filter(Boolean),
    channels: readChannels(),
    hold: readHolds(),
    validation: validation === 'clone' ? extra.validation : buildValidation(validation),
    parameters: readOverrides(),
    prediction: field('prediction').value,
    loss: { ...extra.loss, kind: field('loss').value, noise_model: field('noise_model').value },
    algorithm: readAlgorithm(form, extra.algorithm),
    seed: readNumber('seed') ?? 1,
    posterior: field('posterior').value === 'sampled',
  };
}

/** Build the validation: null, the last part of the recording, or another recording. */
function buildValidation(value) {
  if (!value) return null;
  return value.startsWith('ds_') ? { datasets: [state.validation ?? value] } : { fraction: Number(value) };
}

const derive = (id, steps) => post(address(`/v1/datasets/${encodeURIComponent(id)}:derive`), { steps });

/** Store the chosen part of the recording without what is subtracted, and validation data likewise. */
async function prepareRecording() {
  const steps = readSteps(form);
  state.part = state.validation = null;
  if (!steps.length || !state.dataset) return true;
  try {
    const part = await derive(state.dataset.id, steps);
    state.part = part.id;
    const others = listValidationSteps(part);
    const validation = field('validation').value;
    if (validation.startsWith('ds_') && others.length) state.validation = (await derive(validation, others)).id;
    return true;
  } catch (error) {
    if (!(error instanceof Problem)) throw error;
    form.querySelector('[data-fault="/datasets"]').textContent = `The use of the recording: ${error.errors[0]?.detail ?? error.message}.`;
    showState('');
    field(error.errors[0]?.pointer?.includes('detrend') ? 'detrend' : 'from').focus();
    return false;
  }
}

/** Own equations are checked, and the recording is prepared, before the job is sent. */
async function isReady() {
  return (await isModelReady()) && prepareRecording();
}

async function isModelReady() {
  while (isOwn()) {
    const usable = await checkModel();
    if (usable) return true;
    if (usable === null) continue;
    showState('the model is not valid yet');
    field('equations').focus();
    return false;
  }
  return true;
}

const showState = (text) => forms.showState(form, text);
const withFaults = (work) => forms.withFaults(form, work);

function debounce(work, ms) {
  let timer = 0;
  return () => {
    clearTimeout(timer);
    timer = setTimeout(work, ms);
  };
}

function openPanel() {
  if (location.hash === '#new') panel.open = true;
}

field('dataset').addEventListener('change', withFaults(() => {
  dropUpload();
  return showDataset();
}));
for (const name of ['upload', 'upload-period', 'upload-columns']) field(name).addEventListener('change', withFaults(upload));
document.getElementById('channels').addEventListener('change', proposeBounds);
for (const kind of ['dragover', 'drop'])
  document.addEventListener(kind, (event) => {
    if (![...event.dataTransfer.types].includes('Files')) return;
    event.preventDefault();
    if (kind === 'drop') dropFile(event.dataTransfer.files);
  });

/** Upload a file that was dropped on the page. */
async function dropFile(files) {
  panel.open = true;
  await start();
  field('upload').files = files;
  field('upload').dispatchEvent(new Event('change', { bubbles: true }));
  panel.scrollIntoView();
}

field('model').addEventListener('change', withFaults(() => {
  field('source').value = 'listed';
  // Clear the old model's table at once, so that no typed value is lost.
  state.model = null;
  fillTable({}, {});
  return showListedModel();
}));
for (const button of field('source'))
  button.addEventListener('change', withFaults(() => (isOwn() ? showOwnModel() : showListedModel())));
field('equations').addEventListener('input', () => {
  askModel(async () => null); // drops the answer about the previous text
  document.getElementById('check').replaceChildren(makeElement('span', 'checking…', 'muted'));
});
field('equations').addEventListener('input', debounce(withFaults(() => checkModel()), 300));
forms.onSubmit(form, address('/v1/jobs'), buildBody, isReady);
panel.addEventListener('toggle', withFaults(() => panel.open && start()));
addEventListener('hashchange', openPanel);
openPanel();
if (panel.open) withFaults(start)();
