from .applied import (
    Applied as Applied,
    apply_model as apply_model,
    compare_models as compare_models,
    load_models as load_models,
    predict as predict,
    rows_table as rows_table,
)
from .applied_figures import (
    errors_text as errors_text,
)
from .band_columns import (
    BandedPrediction as BandedPrediction,
)
from .designs import (
    assess_designs as assess_designs,
    continue_file as continue_file,
    write_sequence as write_sequence,
)
from .export.run_export import (
    export_run as export_run,
    write_table as write_table,
)
from .export.typed_tables import (
    Column as Column,
    TypedTable as TypedTable,
)
from .figures.canvas import (
    check_matplotlib as check_matplotlib,
)
from .figures.fits import (
    plot_errors as plot_errors,
    plot_fit as plot_fit,
)
from .figures.panels import (
    Curve as Curve,
    plot_panels as plot_panels,
)
from .figures.planes import (
    plot_densities as plot_densities,
)
from .figures.targets import (
    plot_tracking as plot_tracking,
)
from .inverted import (
    InvertedTargets as InvertedTargets,
    invert_targets as invert_targets,
)
from .model_choice import (
    ALL as ALL,
    SelectedModel as SelectedModel,
    TestedModel as TestedModel,
    evaluate_on as evaluate_on,
    evaluate_on_rows as evaluate_on_rows,
    identify_best as identify_best,
    is_comparison as is_comparison,
    named_models as named_models,
)
from .model_service import (
    FitOptions as FitOptions,
    IdentifiedFile as IdentifiedFile,
    certificate_lines as certificate_lines,
    check_template as check_template,
    error_lines as error_lines,
    fit_sentence as fit_sentence,
    identify_model as identify_model,
    option_names as option_names,
    transients_of as transients_of,
)
from .models_of_several_runs import (
    WholeIdentification as WholeIdentification,
    WholeModel as WholeModel,
    only_run as only_run,
    whole_identification as whole_identification,
    whole_models as whole_models,
)
from .notebook import (
    Report as Report,
    RunTable as RunTable,
)
from .picture import (
    Picture as Picture,
)
from .report.model_card import (
    write_card as write_card,
)
from .report.page.comparison_page import (
    comparison_page as comparison_page,
)
from .report.page.pages import (
    Page as Page,
    PageSection as PageSection,
    PageTable as PageTable,
    write_page as write_page,
)
from .report.published import (
    Published as Published,
)
from .report.run_report import (
    draw_comparison as draw_comparison,
    draw_identification as draw_identification,
    draw_predicted as draw_predicted,
    print_parts as print_parts,
    report_run as report_run,
)
from .run_comparison import (
    RunComparison as RunComparison,
    compare_runs as compare_runs,
)
from .run_folder import (
    ListedRun as ListedRun,
    RunFolder as RunFolder,
    list_runs as list_runs,
    select_runs as select_runs,
)
from .sensor_calibrations import (
    Reference as Reference,
    calibrate_run as calibrate_run,
)
from .session_recalibration import (
    Session as Session,
    session_rows as session_rows,
)
from .tables.data import (
    Quantity as Quantity,
    input_and_output as input_and_output,
    is_run as is_run,
    read_columns as read_columns,
    write_csv as write_csv,
)
from .tables.dataset import (
    NO_TIMES as NO_TIMES,
    ColumnNames as ColumnNames,
    Dataset as Dataset,
    check_unit as check_unit,
    is_rows as is_rows,
    parse_rows as parse_rows,
    read_dataset as read_dataset,
    read_for as read_for,
    time_names as time_names,
)
from .tables.imported import (
    import_file as import_file,
)
from .tables.reading.options import (
    ReadingOptions as ReadingOptions,
)
from .tables.reading.table import (
    FEWEST_ROWS as FEWEST_ROWS,
)
from .tables.starting_state import (
    foreign_drift as foreign_drift,
    starting_state as starting_state,
)
from .tracking_errors import (
    FOLLOW as FOLLOW,
    REACH as REACH,
    READING as READING,
    FollowingResult as FollowingResult,
    TargetResults as TargetResults,
    following_result as following_result,
    results_json as results_json,
    target_results as target_results,
)
from .transients.actuator import (
    IdentifiedActuator as IdentifiedActuator,
    grid_step as grid_step,
    identify_actuator as identify_actuator,
)
from .transients.recorded_transients import (
    TransientRecording as TransientRecording,
    recording_of as recording_of,
)
from .transients.response import (
    SimulatedDrive as SimulatedDrive,
    identify_lag as identify_lag,
    late_parts as late_parts,
)
from .transients.transient_dynamics import (
    identify_dynamics as identify_dynamics,
    identify_transients as identify_transients,
    noise_of as noise_of,
    read_transients as read_transients,
)
from .uncertain_models import (
    propagated as propagated,
    quantity_text as quantity_text,
    spread_row as spread_row,
)
from .uncertain_results import (
    control_uncertainties as control_uncertainties,
    uncertain_signals as uncertain_signals,
)
