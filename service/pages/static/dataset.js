// A page with figures and dialogs: of a dataset, of a comparison.

import './items.js';
import { start } from './figures.js';

start();
