// Shared by all forms: the table of bounds, submission, and faults next to their fields.

import { Problem, address, makeElement, post } from './live.js';

const COMMA_HINT = 'A comma can be read in two ways: write a decimal point, and semicolons between numbers.';
const COLUMNS = ['lower', 'upper', 'fixed'];
const rows = document.getElementById('parameters');
let hiddenChanges = {}; // requested changes without a field

/** List what has bounds: parameters, and the estimated initial values of the first experiment. */
function listBounded(model) {
  const starts = Object.entries(model.initial ?? {}).filter(([, start]) => start?.upper !== undefined);
  const unit = (state) => model.states?.[state] ?? '–';
  return { ...model.parameters, ...Object.fromEntries(starts.map(([state, start]) => [`${state}(0)`, { ...start, unit: unit(state) }])) };
}

/**
 * Select the changes that have no field: scales, ties, and initial values of later experiments.
 * The latter have names such as x(0)[2]. A cloned job may contain them.
 */
function selectHiddenChanges(bounded, changes) {
  const requested = Object.entries(changes).filter(([name]) => name.replace(/\[\d+\]$/, '') in bounded);
  const hidden = requested.map(([name, fields]) => [name, Object.entries(fields).filter(([key]) => !(name in bounded && COLUMNS.includes(key)))]);
  return Object.fromEntries(hidden.filter(([, fields]) => fields.length).map(([name, fields]) => [name, Object.fromEntries(fields)]));
}

/** Fill the table: one row per parameter, with the model's bounds or the requested ones. */
export function fillTable(model, changes) {
  const boundsByName = listBounded(model);
  hiddenChanges = selectHiddenChanges(boundsByName, changes);
  const tableRows = Object.entries(boundsByName).map(([name, bounds]) => {
    const row = document.createElement('tr');
    row.append(makeElement('th', name));
    for (const column of COLUMNS) {
      const input = document.createElement('input');
      input.inputMode = 'decimal';
      input.ariaLabel = `${column} of ${name}`;
      input.dataset.parameter = name;
      input.dataset.column = column;
      input.dataset.pointer = `/parameters/${name}/${column}`;
      const followsData = bounds?.bounds !== undefined && bounds.bounds !== null && column !== 'fixed';
      input.placeholder = followsData ? 'from the data' : '';
      input.dataset.bound = followsData ? '' : bounds?.[column] ?? '';
      input.value = changes[name]?.[column] ?? input.dataset.bound;
      row.append(document.createElement('td'));
      row.lastChild.dataset.label = column;
      row.lastChild.append(input);
    }
    row.append(makeElement('td', bounds?.unit ?? '–', 'muted'), makeElement('td', bounds?.description ?? '', 'muted'));
    row.dataset.row = name;
    return row;
  });
  rows.replaceChildren(...tableRows);
}

/** Show bounds and units that follow from the data, where nothing else was typed. */
export function showProposals(proposals) {
  for (const row of rows.querySelectorAll('[data-row]')) {
    const proposal = proposals[row.dataset.row];
    if (!proposal) continue;
    for (const column of ['lower', 'upper'])
      row.querySelector(`[data-column="${column}"]`).placeholder = String(Number(proposal[column].toPrecision(4)));
    row.children[4].textContent = proposal.unit === '1' ? '–' : proposal.unit;
    row.title = 'Bounds from the data. What you type replaces them.';
  }
}

const DECIMAL_COMMA = /^[-+]?\d*,\d+(e[-+]?\d+)?$/i;
const THOUSANDS = /^[-+]?[1-9]\d{0,2},\d{3}$/;

/**
 * Parse a number with a decimal point or comma. Other text is sent as typed, so that the server
 * reports the fault. Such a text is 1,000, which may be 1 or 1000.
 */
export function parseNumber(text) {
  const typed = text.trim();
  const isClear = DECIMAL_COMMA.test(typed) && !THOUSANDS.test(typed);
  const number = Number(isClear ? typed.replace(',', '.') : typed);
  return typed === '' ? null : Number.isNaN(number) ? typed : number;
}

/** List the fields of the search's settings, each with the names on the way to its setting. */
const listSearchFields = (form) =>
  [...form.querySelectorAll('[data-pointer^="/algorithm/"]')].map((input) => [input, input.dataset.pointer.split('/').slice(2)]);

/** Read the settings of the search over those given. An empty field stands for the default; a list is kept. */
export function readAlgorithm(form, given = {}) {
  const algorithm = structuredClone(given);
  for (const [input, path] of listSearchFields(form)) {
    const name = path.pop();
    const group = path.reduce((node, part) => (node[part] ??= {}), algorithm);
    const value = input instanceof HTMLSelectElement ? input.value : parseNumber(input.value);
    if (value !== null) group[name] = value;
    else if (!Array.isArray(group[name])) delete group[name];
  }
  return algorithm;
}

/** Show settings of the search in their fields. A field without a number or a name stays as it is. */
export function fillAlgorithm(form, algorithm = {}) {
  for (const [input, path] of listSearchFields(form)) {
    const value = path.reduce((node, part) => node?.[part], algorithm);
    if (['number', 'string'].includes(typeof value)) input.value = value;
  }
}

/** Read what differs from the model, as the job body has it. */
export function readOverrides() {
  const changes = structuredClone(hiddenChanges);
  for (const input of rows.querySelectorAll('input')) {
    const text = input.value.trim();
    if (text === '' || text === input.dataset.bound) continue;
    (changes[input.dataset.parameter] ??= {})[input.dataset.column] = parseNumber(text);
  }
  return changes;
}

/** Show every fault once: at its field, or above the button if the form has no field for it. */
export function showFaults(form, problem) {
  const top = form.querySelector('#form-fault');
  const others = problem.errors.filter((fault) => !markFault(form, fault));
  const texts = problem.errors.length ? others.map((fault) => writeFault(nameField(null, fault.pointer), fault)) : [problem.message];
  const summary = problem.errors.length > others.length ? 'Change the marked fields.' : problem.document.title;
  top.replaceChildren(makeElement('b', summary));
  const list = document.createElement('ul');
  texts.forEach((text) => list.append(makeElement('li', text)));
  if (texts.length) top.append(list);
  top.hidden = false;
  (form.querySelector('[aria-invalid="true"]') ?? top).focus();
}

/** Name a field as the form does; one without a field by the words of its pointer. */
const nameField = (input, pointer) =>
  input?.ariaLabel || input?.labels?.[0]?.firstChild?.textContent.trim() || (pointer ?? '').split('/').filter(Boolean).join(', ');

/** Write a fault as a sentence. */
function writeFault(name, { detail, column }) {
  const text = `${name ? `${name}: ` : ''}${detail}${column ? ` (column ${column})` : ''}`;
  return `${text[0].toUpperCase()}${text.slice(1)}${/[.!?]$/.test(text) ? '' : '.'}`;
}

/** Mark the fields of a fault, and write the fault below. Return whether the form has a place for it. */
function markFault(form, fault) {
  const parts = (fault.pointer ?? '').split('/');
  for (; parts.length > 1; parts.pop()) {
    const pointer = parts.join('/');
    const inputs = [pointer, `${pointer}/lower`, `${pointer}/upper`].flatMap((path) => [
      ...form.querySelectorAll(`:is(input, select, textarea)[data-pointer="${CSS.escape(path)}"]`),
    ]);
    const place = form.querySelector(`[data-fault="/${CSS.escape(parts[1])}"]`);
    inputs.forEach((input) => (input.ariaInvalid = 'true'));
    if ((inputs.length || parts.length === 2) && place) {
      const [input] = inputs;
      const isEmpty = input ? input.value.trim() === '' : pointer === fault.pointer;
      const name = inputs.length > 1 ? '' : nameField(input, fault.pointer);
      const text = (isEmpty && (input ?? place).dataset.missing) || writeFault(name, fault);
      const hint = input && /\d,\d/.test(input.value) && COMMA_HINT;
      place.textContent = [place.textContent, text, hint].filter(Boolean).join(' ');
      return true;
    }
  }
  return false;
}

export function clearFaults(form) {
  form.querySelectorAll('.fault[data-fault]').forEach((field) => (field.textContent = ''));
  form.querySelectorAll('[aria-invalid]').forEach((field) => field.removeAttribute('aria-invalid'));
  form.querySelector('#form-fault').hidden = true;
}

/** Show what the form does, or why it does nothing. */
export const showState = (form, text) => (form.querySelector('#form-state').textContent = text);

/** Choices that await an answer. A request must wait for them, because it needs their values. */
let pendingChoices = null;

async function awaitChoices() {
  for (let seen; seen !== pendingChoices; ) {
    seen = pendingChoices;
    await seen;
  }
}

/** Send the body when a form that is ready is submitted. Faults are shown at their fields. */
export function onSubmit(form, url, buildBody, isReady = async () => true) {
  form.addEventListener('submit', async (event) => {
    event.preventDefault();
    clearFaults(form);
    const button = form.querySelector('[type="submit"]');
    button.disabled = true;
    showState(form, 'submitting…');
    try {
      await awaitChoices();
      if (!(await isReady())) {
        button.disabled = false;
        return;
      }
      const job = await post(url, buildBody());
      location.assign(address(`/jobs/${encodeURIComponent(job.id)}`));
    } catch (error) {
      if (!(error instanceof Problem)) throw error;
      showState(form, '');
      showFaults(form, error);
      button.disabled = false;
    }
  });
}

/** Wrap a handler of a choice, so that its faults are shown in the form. */
export const withFaults = (form, work) => async (...args) => {
  const done = work(...args);
  pendingChoices = Promise.allSettled([pendingChoices, done]);
  try {
    await done;
  } catch (error) {
    if (!(error instanceof Problem)) throw error;
    showFaults(form, error);
  }
};
